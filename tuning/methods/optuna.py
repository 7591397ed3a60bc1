"""Optuna's samplers, in batches: the tree-structured Parzen estimator, or one by its name, as `optuna:nsgaii`."""

import dataclasses
import inspect
import warnings
from typing import Any, ClassVar

import numpy as np

from mjx_climb.scenario.messages import ConfigError
from tuning.methods.method import Method, Points, Request, Task
from tuning.problem.search import Search
from tuning.problem.spaces import Space

BATCH = 16
ROUNDS = 40
IN_STEPS = ("bruteforce",)  # samplers of values in steps alone, which gains are not
ENDING = "Sampler"  # of a sampler's class; its name here is the rest, in small letters
# arguments of a sampler, as far as it takes them; `population_size` and `popsize` besides: one round a generation
OPTIONS: dict[str, Any] = {"multivariate": True, "constant_liar": True}


@dataclasses.dataclass(frozen=True)
class Optuna(Method):
    """Batches of `starts` trials of a sampler, the first of them the known gains, the scenario's own before all."""

    most: ClassVar[int] = 100  # numbers: so few trials tell no more apart
    sampler: str = "tpe"

    def check(self, space: Space, search: Search) -> None:
        super().check(space, search)
        self.made(search)

    def rounds(self, task: Task) -> int:
        return task.search.iterations or ROUNDS

    def made(self, search: Search) -> Any:
        """Return the sampler.

        Raises:
            ConfigError: Optuna, or another package that the sampler needs, is not installed; no such sampler, or one
                that takes more than a seed.
        """
        try:
            import optuna
        except ImportError:
            raise ConfigError("", "method", "Optuna to be installed: pip install 'mjx-climb[compare]'") from None
        names = [name for name in optuna.samplers.__all__ if name.endswith(ENDING)]
        known = {name.removesuffix(ENDING).lower(): getattr(optuna.samplers, name) for name in names}
        takes = {name: inspect.signature(kind).parameters for name, kind in known.items()}
        bare = [name for name, each in takes.items() if all(one.default is not one.empty for one in each.values())]
        alone = [name for name in bare if "seed" in takes[name] and name not in IN_STEPS]
        if self.sampler not in alone:
            raise ConfigError("", "method", f"optuna:SAMPLER, one of {', '.join(alone)}", f"{self.sampler!r}")
        size = search.starts or BATCH
        options = {**OPTIONS, "seed": search.seed, "population_size": max(2, size), "popsize": max(2, size)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            try:
                return known[self.sampler](**{n: value for n, value in options.items() if n in takes[self.sampler]})
            except ImportError as error:
                reason = str(error).splitlines()[0]
                raise ConfigError("", "method", f"what optuna:{self.sampler} needs: {reason}") from None

    def run(self, task: Task) -> Points:
        """Ask for batches of trials until the rounds are spent."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        space, study = task.problem.space, optuna.create_study(sampler=self.made(task.search))
        floats = optuna.distributions.FloatDistribution
        box: dict[str, optuna.distributions.BaseDistribution] = {
            name: floats(low, high) for name, low, high in zip(space.names, space.lower, space.upper, strict=True)
        }
        for point in task.known:
            study.enqueue_trial(dict(zip(space.names, point.tolist(), strict=True)))
        for _ in range(self.rounds(task)):
            trials = [study.ask(box) for _ in range(task.search.starts or BATCH)]
            theta = np.array([[trial.params[name] for name in space.names] for trial in trials])
            found = yield Request(theta, None, "trials")
            for trial, merit in zip(trials, found.merit.astype(float).tolist(), strict=True):
                study.tell(trial, merit)


METHOD = Optuna()
