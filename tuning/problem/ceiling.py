"""The settings of a search for the best joint targets over time, which bounds every control law from below."""

import itertools
from collections.abc import Iterator
from typing import Annotated

from pydantic import BeforeValidator

from mjx_climb.scenario.messages import ConfigError
from tuning.problem.search import OF_LIMITS, OF_WEIGHTS, Precision, numbers_of
from tuning.problem.settings import Finite, NonNegative, Positive, Settings, setting


class Ceiling(Settings):
    """A search for joint targets over time, fully specified beside its scenario."""

    weights: dict[str, NonNegative] = OF_WEIGHTS
    limits: dict[str, Finite] = OF_LIMITS
    deviation_factor: Positive = setting(
        3.0, "limit, relative to pd's, of base deviation, swing deviation, joint torque and joint rate"
    )
    better: str = setting("force_variation", "metric of the front", metavar="METRIC", complete="metric")
    against: str | None = setting(
        None, "metric that it is traded against by the clairvoyant plan, along a front", metavar="METRIC",
        complete="metric",
    )  # fmt: skip
    points: int = setting(5, "plans along the front", ge=2, le=100)
    knots: Annotated[tuple[Positive, ...], BeforeValidator(numbers_of)] = setting(
        (0.2, 0.1, 0.05),
        "s between two knots of the joint targets, coarse to fine",
        metavar="S,S,...",
        default_in_words="0.2,0.1,0.05",
        min_length=1,
    )
    delays: Annotated[tuple[NonNegative, ...], BeforeValidator(numbers_of)] = setting(
        (0.002, 0.005, 0.015),
        "s after a disturbance from which on a causal plan may depend on it",
        metavar="S,S,...",
        default_in_words="0.002,0.005,0.015",
    )
    iterations: int = setting(80, "gradients for each spacing of the knots", ge=2, le=100_000)
    test_members: int = setting(
        128, "walks of a fresh draw in which the blind plan and the laws are tested; none without an ensemble", ge=0
    )
    random: int = setting(1, "random starts beside those of pd and of each law", ge=0, le=100)
    step: Positive = setting(0.05, "first step of the descent, as a share of pd's peak joint torque over kp, 1")
    seed: int = setting(0, "of the random starts", ge=0, lt=2**31)
    precision: Precision = setting("float32", "precision of the simulations")

    def faults(self) -> Iterator[ValueError]:
        for coarse, fine in itertools.pairwise(self.knots):
            if not fine < coarse or abs(coarse / fine - round(coarse / fine)) > 1e-6:
                yield ConfigError("", "knots", "each spacing to divide the one before it", f"{coarse:g}, {fine:g}")
        if not any(self.weights.values()):
            yield ConfigError("", "weights", "one above 0")
        if self.better == self.against:
            yield ConfigError("", "against", f"another metric than {self.better}")
