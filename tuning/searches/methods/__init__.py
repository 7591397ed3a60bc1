"""Search methods by name: one file each."""

from tuning.searches.methods import cma_es, gradient, lbfgs, optuna_tpe, refined_grid
from tuning.searches.methods.task import Method, Points, Request, Task

METHODS: dict[str, Method] = {
    "gradient": Method(gradient.rounds, gradient.run),
    "lbfgs": Method(lbfgs.rounds, lbfgs.run),
    "grid": Method(refined_grid.rounds, refined_grid.run),
    "cmaes": Method(cma_es.rounds, cma_es.run),
    "optuna": Method(optuna_tpe.rounds, optuna_tpe.run),
}

__all__ = ["METHODS", "Method", "Points", "Request", "Task"]
