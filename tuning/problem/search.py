"""The settings of the searches: name, unit, bounds, default and help of each, once.

Python, YAML, the documentation and the options of the command line are made from these models. Nothing heavy is
imported here, so that the command line starts at once.
"""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BeforeValidator

from mjx_climb.scenario.kinds import named_in
from mjx_climb.scenario.messages import ConfigError, did_you_mean
from tuning.problem.settings import Finite, NonNegative, Positive, Settings, setting

if TYPE_CHECKING:
    from mjx_climb.walk.metrics import MetricTable

SpaceName = Literal["isotropic", "split", "diagonal"]
Precision = Literal["float32", "float64"]
METHODS = tuple(named_in(Path(__file__).parents[1] / "methods", r"^METHOD = (\w+)").values())
OWN_METHOD = "own"  # one that the caller brought, or that `own.method` of the scenario names
LAYOUTS: tuple[str, ...] = get_args(SpaceName)
WEIGHTS = {"force_variation": 1.0, "peak_foot_force": 1.0, "cost_of_transport": 1.0}
ROBUST_WEIGHTS = {**WEIGHTS, "peak_pull_force": 1.0}  # of a search over an ensemble
LOST = "lost"  # weight of the share of an ensemble's walks that lose a gripper, which then breaks no limit
OF_WEIGHTS = setting(
    WEIGHTS,
    "metric to better and its weight, relative to its value under pd; those named take the place of the default; with "
    "--ensemble also lost, the share of walks that lose a gripper",
    flag="--weight",
    metavar="METRIC=W",
    default_in_words=", ".join(WEIGHTS),
)
OF_LIMITS = setting(
    {},
    "highest value of a metric (lowest, where larger is better), in its unit, as base_deviation=5e-3",
    flag="--limit",
    metavar="METRIC=VALUE",
)


def _method(name: str) -> str:
    """Return the name of a method: a shipped one, own, a sampler of Optuna, or FILE.py:NAME."""
    if name not in (*METHODS, OWN_METHOD) and not re.fullmatch(r"optuna:\w+|.+\.py:\w+", name):
        expected = f"{', '.join(METHODS)}, optuna:SAMPLER or FILE.py:NAME"
        raise ValueError(f"expected {expected}, got {name!r}")
    return name


def numbers_of(text: Any) -> Any:
    """Return the numbers of a text, as 0,1/6,1."""
    from fractions import Fraction

    try:
        return [float(Fraction(part)) for part in text.split(",")] if isinstance(text, str) else text
    except (ValueError, ZeroDivisionError, OverflowError):
        raise ValueError(f"expected numbers with commas between them, got {text!r}") from None


class Search(Settings):
    """A search for gains, fully specified beside its scenario."""

    method: Annotated[str, AfterValidator(_method)] = setting(
        "gradient",
        f"how to search: {', '.join(METHODS)}, a sampler of Optuna by its name, as optuna:nsgaii, or a method of your "
        "own, whose file is run",
        metavar="NAME|FILE.py:NAME",
        complete="method",
        default_in_words="gradient; cmaes on a GPU, and of a gait's times",
    )
    space: SpaceName = setting("isotropic", "which axes share their gains")
    inertia: bool = setting(False, "search the virtual inertia as well", flag="--with-inertia")
    also: tuple[str, ...] = setting(
        (), "gain of the law, or gait.duty, gait.cycle, gait.step_height, gait.settling, to search too", metavar="GAIN"
    )
    joint_gains: bool | None = setting(
        None,
        "search kp and kd of the joint loop as well; null: where there is hardware",
        flag="--with-joint-gains/--without-joint-gains",
    )
    bounds: dict[str, tuple[Finite, Finite]] = setting(
        {},
        "lowest and highest value of a gain, SI units, as stiffness, stiffness.rotation or stiffness.rx",
        flag="--bound",
        metavar="GAIN=LOW:HIGH",
    )
    pins: dict[str, Finite] = setting(
        {}, "gain that keeps a value, SI units, named likewise", flag="--pin", metavar="GAIN=VALUE"
    )
    frozen: tuple[str, ...] = setting(
        (), "gain of the law that keeps its own values, named likewise", flag="--freeze", metavar="GAIN"
    )
    weights: dict[str, NonNegative] = OF_WEIGHTS
    limits: dict[str, Finite] = OF_LIMITS
    deviation_factor: Positive = setting(3.0, "limit of base_deviation relative to pd's, where limits name none")
    no_worse_than_pd: bool = setting(
        True, "no metric with a weight may be worse than under pd", flag="--no-worse-than-pd/--may-be-worse-than-pd"
    )
    starts: int | None = setting(
        None, "starts or population; grid: points per gain; null: the method's", ge=1, le=100_000
    )
    iterations: int | None = setting(None, "rounds of the search; null: the method's", ge=1, le=1_000_000)
    seed: int = setting(0, "seed of all random draws", ge=0, le=2**31 - 1)
    precision: Precision = setting("float32", "precision of the search's simulations")

    def faults(self) -> Iterator[ValueError]:
        if not any(self.weights.values()):
            yield ConfigError("", "weights", "one above 0")
        for name, (low, high) in self.bounds.items():
            if not low < high:
                yield ConfigError("", f"bounds.{name}", "low < high", f"{low:g}, {high:g}")
        for one, other in itertools.combinations(("pins", "frozen", "bounds"), 2):
            if both := [name for name in getattr(self, one) if name in getattr(self, other)]:
                yield ConfigError("", f"{one}.{both[0]}", "one setting of this gain", f"{other}.{both[0]} too")


class Pareto(Settings):
    """Which front is searched."""

    better: str = setting("force_variation", "metric to better", metavar="METRIC", complete="metric")
    against: str = setting(
        "base_deviation", "metric that it is traded against, along a front", metavar="METRIC", complete="metric"
    )
    points: int = setting(12, "limits along the front", ge=2, le=200)

    def faults(self) -> Iterator[ValueError]:
        if self.better == self.against:
            yield ConfigError("", "against", f"another metric than {self.better}")


class Schedule(Settings):
    """The operating points that a schedule has gains for: every pair."""

    gravity: Annotated[tuple[Positive, ...], BeforeValidator(numbers_of)] = setting(
        (1e-6, 1e-2, 1 / 6, 0.38, 1.0),
        "gravities, ascending, 1 G = 9.81 m/s^2",
        metavar="G,G,...",
        default_in_words="1e-6,1e-2,1/6,0.38,1",
        min_length=1,
    )
    cargo: Annotated[tuple[NonNegative, ...], BeforeValidator(numbers_of)] = setting(
        (0.0, 0.5, 1.0),
        "masses of the cargo, ascending, kg",
        metavar="KG,KG,...",
        default_in_words="0,0.5,1",
        min_length=1,
    )

    def faults(self) -> Iterator[ValueError]:
        for name, values in (("gravity", self.gravity), ("cargo", self.cargo)):
            if any(not low < high for low, high in itertools.pairwise(values)):
                yield ConfigError("", name, "ascending numbers", ", ".join(f"{v:g}" for v in values))


class Judge(Settings):
    """The walks that evaluate gains: a draw of an ensemble that no search has seen."""

    members: int = setting(128, "walks of each set of gains", ge=1, le=100_000)


def check_metrics(
    search: Search, metrics: "MetricTable", source: str = "search", *, over_ensemble: bool = False
) -> None:
    """Refuse settings that weigh or limit an unknown metric, by a ConfigError with the source and the name.

    Over an ensemble `LOST` may be weighed too.
    """
    from mjx_climb.walk.metrics import FAILURES

    known = [name for name in metrics.names if name not in FAILURES]
    weighed = [name for name in search.weights if not (over_ensemble and name == LOST)]
    for name in (*weighed, *search.limits):
        if name not in known:
            hint = did_you_mean(name, known, 3)
            reason = f"{name!r} is no metric to weigh or limit{hint}, expected one of {', '.join(known)}"
            raise ConfigError(source, reason=reason)
