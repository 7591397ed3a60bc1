"""The settings of a search: what is searched, how, and for what; validated, and enough to repeat it."""

import os
from difflib import get_close_matches
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import FAILURES, MetricTable
from tuning.problem import settings

Shipped = Literal["gradient", "lbfgs", "grid", "cmaes", "optuna"]
OWN_METHOD = "own"  # one that the caller brought, see `tuning.tune`
Method = Shipped | Literal["own"]
Layout = Literal["isotropic", "split", "diagonal"]

METHODS: tuple[str, ...] = get_args(Shipped)
LAYOUTS: tuple[str, ...] = get_args(Layout)

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]

WEIGHTS = {"force_variation": 1.0, "peak_foot_force": 1.0, "cost_of_transport": 1.0}


class Search(BaseModel):
    """A search for gains, fully specified beside its scenario. Immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Method = Field(default="gradient", description="how to search")
    space: Layout = Field(default="isotropic", description="which axes share their gains")
    inertia: bool = Field(default=False, description="search the virtual inertia as well")
    also: tuple[str, ...] = Field(default=(), description="gains of the law to search that are left alone otherwise")
    joint_gains: bool | None = Field(
        default=None, description="search kp and kd of the joint loop as well; null: where there is hardware"
    )
    bounds: dict[str, tuple[_Positive, _Positive]] = Field(
        default={}, description="lowest and highest value of a gain, as stiffness, stiffness.rotation, stiffness.rx"
    )
    pins: dict[str, _Positive] = Field(default={}, description="gains that keep a value, named likewise")
    weights: dict[str, _Weight] = Field(
        default=WEIGHTS, description="metrics to better, each relative to its value under pd"
    )
    limits: dict[str, _Finite] = Field(
        default={}, description="highest value of a metric (lowest, where larger is better), in its unit"
    )
    deviation_factor: _Positive = Field(
        default=3.0, description="limit of base_deviation relative to pd's, where limits names none"
    )
    no_worse_than_pd: bool = Field(default=True, description="no metric with a weight may be worse than under pd")
    starts: Annotated[int, Field(ge=1, le=100_000)] | None = Field(
        default=None, description="points searched side by side: starts, or the population"
    )
    iterations: Annotated[int, Field(ge=1, le=1_000_000)] | None = Field(default=None, description="rounds")
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(default=0, description="of all random draws")
    precision: Literal["float32", "float64"] = Field(default="float32", description="of the search's simulations")

    @model_validator(mode="after")
    def _makes_sense(self) -> "Search":
        if not any(self.weights.values()):
            raise ValueError("weights: expected one above 0")
        for name, (low, high) in self.bounds.items():
            if not low < high:
                raise ValueError(f"bounds.{name}: expected low < high, got {low:g}, {high:g}")
        return self

    def to_yaml(self) -> str:
        """Return the settings as YAML; loading it gives equal ones."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=110)


def make(values: dict[str, Any], source: str = "search") -> Search:
    """Return validated settings.

    Raises:
        ConfigError: in one line, key and what is wrong.
    """
    return settings.validated(Search, values, source)


def check_metrics(search: Search, metrics: MetricTable, source: str = "search") -> None:
    """Refuse settings that weigh or limit what is no metric.

    Raises:
        ConfigError: in one line, the source and the name.
    """
    for name in (*search.weights, *search.limits):
        if name not in metrics.names or name in FAILURES:
            known = [metric for metric in metrics.names if metric not in FAILURES]
            near = get_close_matches(name, known)
            hint = f" (did you mean {' or '.join(near)}?)" if near else ""
            raise ConfigError(
                f"{source}: {name!r} is no metric to weigh or limit{hint}, expected one of {', '.join(known)}"
            )


def load(path: str | os.PathLike[str]) -> Search:
    """Read settings from YAML; keys that the file leaves out take their defaults.

    Raises:
        ConfigError: in one line, what is wrong.
    """
    return make(*settings.read(path))


def parse(text: str, source: str = "search") -> Search:
    """Return the settings that a YAML text holds."""
    return make(settings.mapping(text, source), source)
