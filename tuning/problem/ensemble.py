"""An ensemble of walks round one scenario: pushes, cargo, slope, grips, masses and hardware drawn from a seed.

Each quantity is drawn from a range by a Latin hypercube: with m members one value falls into each m-th of its range.
Masses are off by one factor for all links (`mjx_climb.Parameters.mass_scale`).
"""

import dataclasses
import enum
import functools
import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

import mjx_climb as mc
from mjx_climb.arrays import namespace
from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.disturbances.on_base import Cargo as OwnCargo
from mjx_climb.disturbances.on_base import Push
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.scenario.messages import ConfigError
from tuning.problem.settings import Finite, NonNegative, Positive, Settings, setting
from tuning.problem.variations import (
    PERIOD,
    Change,
    Factor,
    changed,
    checked,
    paths_of,
    refused,
    scalable,
    whole_periods,
)

_Share = Annotated[float, Field(gt=0, le=1)]
Range = tuple[NonNegative, NonNegative]
PositiveRange = tuple[Positive, Positive]
FRESH_SEED = 1_000_003  # added to the ensemble's own for the draw that no search sees
_STIFFNESS = "contact.stiffness"
TILTS = ("gravity.tilt_x", "gravity.tilt_y")
AnyRange = tuple[Finite, Finite]


class _Section(Settings):
    def faults(self) -> Iterator[ValueError]:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, tuple) and not value[0] <= value[1]:
                yield ConfigError("", name, "low <= high", f"{value[0]:g}, {value[1]:g}")


class Pushes(_Section):
    """Pushes on the base in place of the scenario's own, each in a direction drawn evenly over the sphere."""

    count: int = setting(2, "pushes per walk", ge=0, le=20)
    force: Range = setting((1.0, 5.0), "size, N")
    start: Range = setting((0.5, 7.0), "first instant, s")
    length: PositiveRange = setting((0.2, 1.0), "duration, s")


class Cargo(_Section):
    """Cargo in place of the scenario's own; it stays as long as the scenario says."""

    mass: Range = setting((0.0, 1.5), "kg")
    start: Range = setting((1.0, 3.0), "time of loading, s")


class Gravity(_Section):
    """Errors of gravity."""

    scale: Range = setting((0.9, 1.1), "factor on the scenario's gravity")
    slope: Range = setting((0.0, 10.0), "tilt against the scenario's gravity to any side, degrees")


class Hardware(_Section):
    """Ranges of the loop's hardware. A range that is null leaves the scenario's own; each walk has its own noise."""

    force_delay: Range | None = setting(None, "age of the forces, s")
    command_delay: Range | None = setting(None, "from the law to the joints, s")
    control_rate: PositiveRange | None = setting(
        None, "of law and joint targets, Hz, even in its logarithm; periods are whole time steps"
    )
    force_noise: Range | None = setting(None, "standard deviation per axis and sample, N")
    force_bias: AnyRange | None = setting(None, "offset on every axis of every sensor, N")
    force_filter: PositiveRange | None = setting(None, "cut-off, Hz, even in its logarithm")
    friction: PositiveRange | None = setting(None, "factor on all friction of the servo, even in its logarithm")
    armature: PositiveRange | None = setting(None, "factor on the armature, even in its logarithm")
    backlash: Range | None = setting(None, "play of the gears from end to end, rad")
    capture_distance: PositiveRange | None = setting(None, "how far off the ground a gripper holds what it shuts on, m")


_OF_HARDWARE = {  # path of a quantity of the section
    "force_delay": "hardware.force_sensor.delay",
    "command_delay": "hardware.command_delay",
    "force_noise": "hardware.force_sensor.noise",
    "force_bias": "hardware.force_sensor.bias",
    "backlash": "hardware.servo.backlash",
    "capture_distance": "contact.capture_distance",
    "force_filter": "hardware.force_sensor.filter",
}


class Drawn(_Section):
    """One number of a walk, drawn from a range, or the scenario's own times a factor."""

    range: AnyRange | None = setting(None, "values, in the unit of the path")
    factor: PositiveRange | None = setting(None, "factor on the scenario's own value")
    log: bool = setting(False, "even in the logarithm")

    def faults(self) -> Iterator[ValueError]:
        yield from super().faults()
        if (self.range is None) == (self.factor is None):
            yield ValueError(f"expected a range or a factor, got {'none' if self.range is None else 'both'}")
        if self.log and not self.span[0] > 0:
            yield ValueError(f"range: expected numbers above 0 with log, got {self.span[0]:g}")

    @property
    def span(self) -> tuple[float, float]:
        """The ends of the range, or of the factor."""
        return self.range or self.factor or (1.0, 1.0)


class Posterior(Settings):
    """Parameters as `mjx-climb identify` left them: normal in their coordinates, cut at bounds."""

    keys: tuple[str, ...] = setting(..., "keys of a scenario; gravity.tilt_x, gravity.tilt_y: angles that turn gravity")
    log: tuple[bool, ...] = setting(..., "whether the coordinate of each is its logarithm")
    mean: tuple[Finite, ...] = setting(..., "of the coordinates")
    covariance: tuple[tuple[Finite, ...], ...] = setting(..., "of the coordinates")
    lower: tuple[float, ...] = setting(..., "bounds of the values")
    upper: tuple[float, ...] = setting(..., "bounds of the values")
    held: tuple[str, ...] = setting((), "fitted keys that members cannot differ in: the robot's, at their estimates")

    def faults(self) -> Iterator[ValueError]:
        count = len(self.keys)
        for name in ("log", "mean", "covariance", "lower", "upper"):
            rows = getattr(self, name)
            if len(rows) != count or (name == "covariance" and any(len(row) != count for row in rows)):
                yield ConfigError("", f"posterior.{name}", f"one for each of {count} keys")
        for key in self.keys:
            if "." not in key:
                yield ConfigError("", "posterior.keys", "keys of a scenario", f"{key!r}")

    def draw(self, rng: np.random.Generator, members: int, gravity: np.ndarray) -> dict[str, np.ndarray]:
        """Return values by path, (members, 1) each."""
        points = rng.multivariate_normal(self.mean, self.covariance, members, method="eigh")
        points = np.where(self.log, np.exp(np.where(self.log, points, 0.0)), points)
        points = np.clip(points, self.lower, self.upper)
        found = {key: points[:, n, None] for n, key in enumerate(self.keys) if key not in TILTS}
        turns = np.zeros((members, 3))
        for n, key in enumerate(self.keys):
            if key in TILTS:
                turns[:, TILTS.index(key)] = points[:, n]
        if turns.any():
            from scipy.spatial.transform import Rotation  # takes 0.17 s to load: few commands draw any gravity

            found["gravity"] = Rotation.from_rotvec(turns).apply(gravity)[:, None]
        return found


class Worst(_Section):
    """How much the worst members count beside the mean."""

    share: _Share = setting(0.2, "share of the members that are the worst")
    weight: _Share = setting(0.5, "weight of their mean; the mean of all has the rest")


class Ensemble(_Section):
    """The ranges of an ensemble's walks. A section that is null leaves the scenario's own as it is."""

    members: int = setting(16, "walks per set of gains", ge=1, le=100_000)
    seed: int = setting(0, "of the draw", ge=0, lt=2**31)
    pushes: Pushes | None = setting(Pushes(), "what hits the robot")
    cargo: Cargo | None = setting(Cargo(), "what it carries")
    gravity: Gravity | None = setting(Gravity(), "where it climbs")
    grip_stiffness: PositiveRange = setting(
        (0.5, 2.0), "factor on contact.stiffness, if there is one, even in its logarithm"
    )
    robot_mass: PositiveRange = setting((0.9, 1.1), "factor on the masses and inertias of all links")
    hardware: Hardware | None = setting(None, "what stands between the law and the joints")
    draw: dict[str, Drawn] = setting(
        {}, "numbers of the walk by path, as contact.damping: {range: [10, 30]}, drawn last"
    )
    posterior: Posterior | None = setting(None, "what identify left of parameters, before all others are drawn")
    worst: Worst = setting(Worst(), "the worst members in the objective")


class Use(enum.IntEnum):
    """The use of the walks of an ensemble: each has draws of its own."""

    TEST = 1  # of the result of a search
    EVALUATION = 2  # of gains by `mjx-climb evaluate`
    CHECK = 3  # of the best points of a search, before it ends


def fresh(ensemble: Ensemble, use: Use = Use.TEST) -> Ensemble:
    """Return the ensemble whose members no search of the given one, and no other use, has seen."""
    return ensemble.model_copy(update={"seed": ensemble.seed + use * FRESH_SEED})


def of_search(ensemble: Ensemble, number: int) -> Ensemble:
    """Return the ensemble that the search of this number draws, from 0 on: the given one, then others."""
    return ensemble.model_copy(update={"seed": ensemble.seed + number})


def draw(scenario: mc.Scenario, ensemble: Ensemble) -> mc.Parameters:
    """Return the parameters of all members in float64: axes (members, 1) before each value's own, to meet (B, 6) gains.

    Raises:
        ConfigError: a factor on a value that the scenario does not have, a control rate or delays that its time step
            cannot tell, or contacts and joints, of a member or at the ends of the ranges, that it cannot follow.
    """
    rng = np.random.default_rng(ensemble.seed)
    drawn = _drawn(scenario, ensemble, rng, _uniform)
    ends = _drawn(scenario, ensemble.model_copy(update={"members": 2}), rng, _ends)
    for each in (ends, drawn):
        check_time_step(scenario, "ensemble", each)
    return drawn


def _drawn(
    scenario: mc.Scenario, ensemble: Ensemble, rng: np.random.Generator, values: Callable[..., np.ndarray]
) -> mc.Parameters:
    """Return the parameters of members whose `values` are of ranges, as `_uniform` draws them."""
    uniform = functools.partial(values, rng, ensemble.members)
    own = own_parameters(scenario)
    if ensemble.posterior is not None:  # of a generator of its own: other draws stay as they are
        of_posterior = np.random.default_rng([ensemble.seed, 1])
        known = ensemble.posterior.draw(of_posterior, ensemble.members, np.asarray(own.gravity))
        if unknown := [path for path in known if path not in own.paths]:
            raise refused(unknown[0], own, "posterior.keys")
        own = own.replace(known)
    grip = Factor(uniform(ensemble.grip_stiffness, logs=True))
    changes: dict[str, Change] = {}
    if _STIFFNESS in own.paths:
        changes[_STIFFNESS] = grip
    elif ensemble.grip_stiffness != Ensemble().grip_stiffness:
        raise refused(_STIFFNESS, own, "grip_stiffness")
    changes["mass_scale"] = uniform(ensemble.robot_mass)
    if (cargo := ensemble.cargo) is not None:
        changes |= {"disturbance.cargo.mass": uniform(cargo.mass), "disturbance.cargo.start": uniform(cargo.start)}
    if (gravity := ensemble.gravity) is not None:
        axis, angle = uniform((0.0, 2 * np.pi)), np.radians(uniform(gravity.slope))
        changes["gravity"] = uniform(gravity.scale)[..., None] * _tilted(np.asarray(own.gravity), axis, angle)
    if (pushes := ensemble.pushes) is not None:
        own = dataclasses.replace(own, disturbances=_pushed(own.disturbances, pushes, uniform))
    if ensemble.hardware is not None:
        changes |= _hardware(scenario, ensemble.hardware, own, uniform)
        changes["hardware.seed"] = rng.integers(0, 2**24, (ensemble.members, 1)).astype(float)
    drawn = changed(own, changes)
    return drawn if not ensemble.draw else _at_paths(scenario, drawn, own, ensemble, values)


def _at_paths(
    scenario: mc.Scenario,
    drawn: mc.Parameters,
    own: mc.Parameters,
    ensemble: Ensemble,
    of_range: Callable[..., np.ndarray],
) -> mc.Parameters:
    """Return a draw with the numbers that are drawn by path, factors on the scenario's own.

    Raises:
        ConfigError: a path that the walk does not have, or values that it cannot have.
    """
    # of a generator of its own: other draws stay as they are
    rng, paths, changes = np.random.default_rng([ensemble.seed, 2]), drawn.paths, dict[str, Change]()
    for path, how in ensemble.draw.items():
        key = f"draw.{path}"
        if path not in paths:
            raise refused(path, drawn, key)
        values = of_range(rng, ensemble.members, how.span, logs=how.log)
        if how.factor is not None:
            if not scalable(own, [path]):
                raise ConfigError("", key, "a value other than 0 in the scenario to scale", "0")
            changes[path] = changed(own, {path: Factor(values)}).at(path)
        elif paths[path].shape:
            raise ConfigError("", key, "a factor, as the value is an array", "a range")
        else:
            changes[path] = values
    if "hardware.seed" not in changes and any(path.startswith("hardware.") for path in changes):
        changes["hardware.seed"] = rng.integers(0, 2**24, (ensemble.members, 1)).astype(float)
    return checked(scenario, drawn, changes, "draw.{}")


def _pushed(
    disturbances: tuple[Disturbance, ...], pushes: Pushes, uniform: Callable[..., np.ndarray]
) -> tuple[Disturbance, ...]:
    """Return disturbances with drawn pushes in place of their own."""
    n = pushes.count
    up, azimuth = uniform((-1.0, 1.0), n), uniform((0.0, 2 * np.pi), n)
    across = np.sqrt(1 - up**2)
    direction = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=-1)
    start = uniform(pushes.start, n)
    force = uniform(pushes.force, n)[..., None] * direction
    stop = start + uniform(pushes.length, n)
    drawn: list[Any] = [
        {"force": force[..., k, :], "moment": np.zeros(3), "start": start[..., k], "stop": stop[..., k]}
        for k in range(n)
    ]
    before = [each for each in disturbances if isinstance(each, OwnCargo)]
    after = [each for each in disturbances if not isinstance(each, OwnCargo | Push)]
    return (*before, *(Push(**each) for each in drawn), *after)


def _uniform(
    rng: np.random.Generator, members: int, span: tuple[float, float], *shape: int, logs: bool = False
) -> np.ndarray:
    """Return (members, 1, *shape), one value in each m-th of the span, or of its logarithm."""
    low, high = map(math.log, span) if logs else span
    values = hypercube(rng, members, np.full(math.prod(shape), low), high).reshape(members, 1, *shape)
    return np.exp(values) if logs else values


def _ends(_: object, members: int, span: tuple[float, float], *shape: int, logs: bool = False) -> np.ndarray:
    """Return the ends of a span for two members, as `_uniform` returns values between them."""
    return np.multiply.outer(span, np.ones((1, *shape)))


def _hardware(
    scenario: mc.Scenario, hardware: Hardware, own: mc.Parameters, uniform: Callable[..., np.ndarray]
) -> dict[str, Change]:
    """Return the changes of the members' hardware, (members, 1) each."""
    drawn: dict[str, Change] = {}
    fastest = 1 / scenario.time_step
    for name, path in _OF_HARDWARE.items():
        if (span := getattr(hardware, name)) is None:
            continue
        checked(scenario, own, {path: span[1]}, f"hardware.{name}")
        drawn[path] = uniform(span, logs=name == "force_filter")
    if (rate := hardware.control_rate) is not None:
        if rate[1] > fastest * (1 + 1e-9):
            most = f"the {fastest:g} Hz of the time step"
            raise ConfigError("", "hardware.control_rate", f"at most {most}", f"{rate[1]:g}")
        drawn[PERIOD] = whole_periods(1 / uniform(rate, logs=True), scenario.time_step)
    for key in ("friction", "armature"):
        if (span := getattr(hardware, key)) is None:
            continue
        scaled = scalable(own, paths_of(own, key))
        if not scaled:
            raise ConfigError("", f"hardware.{key}", f"{key} in the scenario to scale", "none")
        drawn |= dict.fromkeys(scaled, Factor(uniform(span, logs=True)))
    return drawn


def _tilted(gravity: np.ndarray, azimuth: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return gravity (..., 3) turned by `angle` about the horizontal axis at `azimuth`, by Rodrigues' formula."""
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
    sine, cosine = np.sin(angle)[..., None], np.cos(angle)[..., None]
    along = (axis * gravity).sum(-1, keepdims=True) * axis
    return np.asarray(along + cosine * (gravity - along) + sine * np.cross(axis, gravity))


def hypercube(rng: np.random.Generator, count: int, lower: np.ndarray, upper: ArrayLike) -> np.ndarray:
    """Return points (count, n) between bounds (n,): of each coordinate one in each part of `count`."""
    strata = np.argsort(rng.random((lower.size, count)), axis=1).T
    return np.asarray(lower + (np.asarray(upper) - lower) * (strata + rng.random((count, lower.size))) / count)


def worst_mean(values: Any, share: float, *, larger_is_better: bool = False) -> Any:
    """Return the mean over the worst members (axis 0), the conditional value at risk: (members, ...) -> (...)."""
    count = max(1, math.ceil(share * values.shape[0] - 1e-9))
    # NumPy sorts rows in half the time of columns
    ordered = namespace(values).sort(values.T.copy(), axis=-1).T
    return (ordered[:count] if larger_is_better else ordered[-count:]).copy().mean(0)
