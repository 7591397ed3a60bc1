"""How a rollout is compiled and where it runs: all that leans on the insides of JAX and XLA."""
