"""Search methods by name, one file each."""

from tuning.methods import cma_es, descents, optuna_tpe, refined_grid
from tuning.methods.rounds import Method, Points, Request, Task

METHODS: dict[str, Method] = {
    "gradient": Method(descents.rounds, descents.gradient),
    "lbfgs": Method(descents.rounds, descents.lbfgs),
    "grid": Method(refined_grid.rounds, refined_grid.run),
    "cmaes": Method(cma_es.rounds, cma_es.run),
    "optuna": Method(optuna_tpe.rounds, optuna_tpe.run),
}

__all__ = ["METHODS", "Method", "Points", "Request", "Task"]
