"""Optuna's tree-structured Parzen estimator, in batches."""

import warnings

import numpy as np

from mjx_climb.scenario.messages import ConfigError
from tuning.methods.rounds import Points, Request, Task, check_size

MOST = 100  # numbers to search
BATCH = 16
ROUNDS = 40


def rounds(task: Task) -> int:
    """Return how many batches a run takes; ConfigError: more numbers than so few trials tell apart."""
    check_size(task, MOST)
    return task.search.iterations or ROUNDS


def run(task: Task) -> Points:
    """Ask for batches of trials, the first of them the known gains, the scenario's own before all.

    Raises:
        ConfigError: Optuna is not installed.
    """
    try:
        import optuna
    except ImportError:
        raise ConfigError("method: expected Optuna to be installed: pip install 'mjx-climb[compare]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    space = task.problem.space
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(seed=task.search.seed, multivariate=True, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    floats = optuna.distributions.FloatDistribution
    box: dict[str, optuna.distributions.BaseDistribution] = {
        name: floats(low, high) for name, low, high in zip(space.names, space.lower, space.upper, strict=True)
    }
    for point in task.known:
        study.enqueue_trial(dict(zip(space.names, point.tolist(), strict=True)))
    for _ in range(rounds(task)):
        trials = [study.ask(box) for _ in range(task.search.starts or BATCH)]
        theta = np.array([[trial.params[name] for name in space.names] for trial in trials])
        found = yield Request(theta, None, "trials")
        for trial, merit in zip(trials, found.merit.astype(float).tolist(), strict=True):
            study.tell(trial, merit)
