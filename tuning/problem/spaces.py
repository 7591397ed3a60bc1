"""Spaces of gains: the numbers that a search moves, their bounds, and the gains that they stand for.

A point theta holds the natural logarithm of a gain whose bounds are above 0; a gain that may be 0 or less it holds
itself, in units of its own. Names of its coordinates: `damping` and `stiffness` where all axes share a gain;
`damping.translation`, `damping.rotation`; or `damping.x`, .. `damping.rz`; likewise any other gain of six axes; a gain
of three has translations alone, a gain of one number is one coordinate. An array of another shape has a coordinate for
each of its numbers, `weights.0.11`. And `kp`, `kd`, `ki`, and those of the gait: `gait.duty`, `gait.cycle`,
`gait.step_height`, ....
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.files.dataset import SIX
from mjx_climb.gait.base_path import check_base
from mjx_climb.hardware.stages import IDEAL, stages_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.gait_values import GAIT, TIMES, gait_of, own_gait, scenario_with_gait, why_fixed
from mjx_climb.inputs.resolve import AnyGains, has_gains_of_the_paper
from mjx_climb.inputs.time_step import short_enough
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import RobotFile
from mjx_climb.value_field import ValueField
from tuning.problem.ensemble import hypercube
from tuning.problem.search import LAYOUTS, Search

PARTS = ("translation", "rotation")
JOINT = {"kp": (5.0, 4.0), "kd": (10.0, 10.0)}  # bounds: how many times below and above the scenario's own
SEARCHED_GAIT = tuple(name for name in GAIT if name != "gait.stride")  # the speed of travel is held
INTEGRAL = "ki"  # searched where the scenario has an integral term, or where asked for
_INTEGRAL = 10.0  # bounds: how many times below and above
_PER_KP = 0.5  # 1/s, ki over kp, as registers of public robots have them: in place of a scenario's ki of zero
_LONGEST_STANCE = 0.95  # duty, up to which searches look
_SHARES = (0.02, 0.5)  # of a swing: a foot's wait; of the way: the base's sway
_HEIGHT = (0.85, 1.15)  # of that of the rest stance
_LANDING = (1e-3, 0.2)  # m/s
_GAIT_FACTOR = 2.0  # cycle and step height: so many times below and above the scenario's own
_DAMPED = 0.004  # s, kd over kp of the paper's joint loop: in place of a scenario's kd of zero
_BOUNDED_FOR = "hubrobo_v3_2"  # the robot that bounds of the paper's gains are for
# Units of a coordinate that is no logarithm, between its bounds: about as many as a gain's bounds, a factor of 1000
# apart, have in their logarithm, so that methods move both kinds alike.
_UNITS = 7.0


@dataclasses.dataclass(frozen=True)
class Space:
    """A box of gains, and the map from it to gains."""

    names: tuple[str, ...]  # of the n coordinates
    lower: np.ndarray  # (n,) the bounds
    upper: np.ndarray
    units: np.ndarray  # (n,) the gain at 1, of a coordinate that is the gain itself; 0: it is the natural logarithm
    index: dict[str, np.ndarray]  # gain: which entries of [theta, fixed values] make it, of the gain's shape
    fixed: np.ndarray  # (m,) the values that are not searched

    @property
    def size(self) -> int:
        """How many numbers are searched."""
        return len(self.names)

    @property
    def gains(self) -> list[str]:
        """The names of the gains that are searched on one or more axes, stiffness and damping first."""
        kinds = dict.fromkeys(map(kind_of, self.names))
        return sorted(kinds, key=lambda kind: {"stiffness": 0, "damping": 1}.get(kind, 2))

    @property
    def smooth(self) -> np.ndarray:
        """Which coordinates metrics have derivatives along (n,) bool: all but times, counted in whole steps."""
        return np.array([name not in TIMES for name in self.names], bool)

    @functools.cached_property
    def of_arrays(self) -> np.ndarray:
        """Which coordinates are numbers of an array without axes (n,) bool."""
        return np.array([name.rpartition(".")[2].isdigit() for name in self.names], bool)

    @functools.cached_property
    def parts(self) -> dict[str, np.ndarray]:
        """Which coordinates (n,) bool tests and tables tell apart, by name: single ones, and arrays as a whole."""
        own = zip(self.names, self.of_arrays, strict=True)
        names = np.array([kind_of(name) if of_array else name for name, of_array in own])
        return {name: names == name for name in dict.fromkeys(names.tolist())}

    @functools.cached_property
    def strides(self) -> np.ndarray:
        """How far a method moves each coordinate (n,): all numbers of an array together as far as one gain."""
        return 1 / np.sqrt(sum(own * np.count_nonzero(own) for own in self.parts.values()))

    def scaled(self, theta: np.ndarray, factor: float, part: str) -> np.ndarray:
        """Return a point (n,) with one of the `parts` so many times as large."""
        larger = np.where(self.units > 0, theta * factor, theta + np.log(factor))
        return np.where(self.parts[part], larger, theta)

    def to_gains(self, theta: Float[Array, "*batch n"] | Float[np.ndarray, "*batch n"]) -> AnyGains:
        """Return the gains of points, with their batch axes: `mc.Gains` where they are the paper's, else by name."""
        # NumPy's functions for NumPy's arrays, which JAX would compile one by one
        numpy = jnp if isinstance(theta, jax.Array) else np
        linear = self.units > 0
        searched = numpy.where(linear, self.units * theta, numpy.exp(numpy.where(linear, 0.0, theta)))
        fixed = numpy.broadcast_to(self.fixed, (*theta.shape[:-1], self.fixed.size))
        return self._by_gain(numpy.concatenate([searched, fixed], axis=-1, dtype=theta.dtype))

    def to_tangents(self, theta: Float[np.ndarray, "*batch n"], along: Float[np.ndarray, "k n"]) -> AnyGains:
        """Return the derivatives of the gains of points along k directions, an axis ahead of the batch axes."""
        slope = np.where(self.units > 0, self.units, np.exp(np.where(self.units > 0, 0.0, theta)))
        searched = slope * np.expand_dims(along, tuple(range(1, theta.ndim)))
        return self._by_gain(np.concatenate([searched, np.zeros((*searched.shape[:-1], self.fixed.size))], axis=-1))

    def _by_gain(self, values: Array | np.ndarray) -> AnyGains:
        return as_gains({name: values[..., index] for name, index in self.index.items()})

    def from_gains(self, gains: AnyGains) -> np.ndarray:
        """Return the point (n,) nearest to some gains: (geometric) means of shared ones, clipped to the bounds."""
        values = gains if isinstance(gains, Mapping) else vars(gains)
        totals, counts = np.zeros((2, self.size))
        for name, index in self.index.items():
            if values.get(name) is None:
                continue
            places, searched = np.ravel(index), np.ravel(index) < self.size
            given = np.broadcast_to(np.asarray(values[name], float), np.shape(index)).ravel()[searched]
            np.add.at(totals, places[searched], _coordinates(given, self.units[places[searched]]))
            np.add.at(counts, places[searched], 1)
        return self.clip(totals / np.maximum(counts, 1))

    def clip(self, theta: np.ndarray) -> np.ndarray:
        """Return the nearest points inside the bounds."""
        return np.asarray(np.clip(theta, self.lower, self.upper))

    @functools.cached_property
    def ties(self) -> np.ndarray:
        """Which coordinates are the same gain of different axes: (k, n), a row of zeros and ones per gain or number."""
        own = zip(self.names, self.of_arrays, strict=True)
        kinds = [name if alone else kind_of(name) for name, alone in own]
        rows = {kind: row for row, kind in enumerate(dict.fromkeys(kinds))}
        ties = np.zeros((len(rows), self.size))
        ties[[rows[kind] for kind in kinds], np.arange(self.size)] = 1
        return ties

    def draw_tied(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return points (count, n) whose axes have the same gains, as far as the bounds let them: a hypercube too."""
        ties = self.ties
        low = np.array([self.lower[row > 0].max() for row in ties])
        high = np.array([self.upper[row > 0].min() for row in ties])
        return self.clip(hypercube(rng, count, low, np.maximum(low, high)) @ ties)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return points (count, n), a Latin hypercube."""
        return hypercube(rng, count, self.lower, self.upper)

    def on_bound(self, theta: np.ndarray, tolerance: float = 1e-3) -> list[str]:
        """Return the names of the `parts` that lie on a bound, at any number."""
        reach = tolerance * (self.upper - self.lower)
        beside = (theta - self.lower <= reach) | (self.upper - theta <= reach)
        return [name for name, own in self.parts.items() if beside[own].any()]


NO_SPACE = Space((), np.zeros(0), np.zeros(0), np.zeros(0), {}, np.zeros(0))


def searches_gait(space: Space) -> bool:
    """Return whether points of a space have a gait of their own."""
    return not space.index.keys().isdisjoint(GAIT)


def kind_of(coordinate: str) -> str:
    """Return the gain that a coordinate is of."""
    return coordinate if coordinate in GAIT else coordinate.split(".")[0]


def _coordinates(values: ArrayLike, units: np.ndarray) -> np.ndarray:
    """Return coordinates of some values: their logarithms, or themselves in units."""
    values = np.asarray(values, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(units > 0, values / np.where(units > 0, units, 1.0), np.log(np.maximum(values, 0.0)))


def space(scenario: mc.Scenario, search: Search, law: mc.Law | None = None) -> Space:
    """Return the space that the settings ask for around a law's own gains, the scenario's law where None is given.

    Raises:
        ConfigError: bounds or pins of a gain that is not there, a controller without gains, nothing left to search.
    """
    law = law_of(scenario) if law is None else law
    own, of_law, others = found = _gains(scenario, search, law)
    if not law.GAINS and all(name in GAIT and name not in search.also for name in others):
        raise ConfigError("", "control.controller", "an admittance law", "pd, which has no gains to search")
    if unknown := sorted({*search.also} - {*(names := added(law))}):
        raise ConfigError("", "also", f"gains of the law, {', '.join(names)}", unknown[0])
    check_gait(scenario, search)
    defaults = default_bounds(scenario, law) | _integral_bounds(scenario) | _gait_bounds(scenario)
    keys_of_gains, bounds = of_law | others, dict[str, tuple[float, float]]()
    used: set[str] = set()  # keys that decide about a number

    def number(keys: list[str], value: float, field: ValueField | None) -> str | float:
        """Return a number's name, or its value where that is held, by its keys: the most particular one decides."""
        named = next((key for key in reversed(keys) if key in {*search.pins, *search.frozen, *search.bounds}), "")
        used.add(named)
        if named in search.pins:
            return search.pins[named]
        if named in search.frozen:
            return value
        sources = search.bounds, defaults  # the user's before the defaults
        low, high = next(source[key] for source in sources for key in reversed(keys) if key in source)
        if not (low > 0 or signed(field)):
            raise ConfigError("", f"bounds.{keys[-1]}", "a low end above 0", f"{low:g}")
        bounds[keys[-1]] = low, high
        return keys[-1]

    entries: dict[str, list[str | float]] = {}
    for gain, value in own.items():
        values, field = np.ravel(value), law.GAINS.get(gain)
        if (keys := keys_of_gains.get(gain)) is not None:
            # the rotations of a law that has none keep their values
            searched = [number(each, value, field) for each, value in zip(keys, values, strict=False)]
            entries[gain] = [*searched, *values[len(keys) :]]
        else:
            used.add(gain)
            entries[gain] = [search.pins.get(gain, each) for each in values]
    for section, allowed in found.named_by(search).items():
        for key in getattr(search, section):
            if key not in allowed:
                plain = sorted(each for each in allowed if not each.rpartition(".")[2].isdigit())
                raise ConfigError("", f"{section}.{key}", f"one of {', '.join(plain)}")
            if key not in used:
                raise ConfigError("", f"{section}.{key}", "a gain with numbers of no other setting", "none")
    for key, value in search.pins.items():
        if not (value > 0 or signed(law.GAINS.get(kind_of(key)))):
            raise ConfigError("", f"pins.{key}", "a number above 0", f"{value:g}")
    return _space(own, entries, bounds)


class _Gains(NamedTuple):
    """The gains around a search."""

    own: dict[str, Any]  # values by name, 0 of joint loop and gait
    of_law: dict[str, list[list[str]]]  # the keys of each number of those that are searched
    others: dict[str, list[list[str]]]  # likewise, of joint loop and gait

    def named_by(self, search: Search) -> dict[str, set[str]]:
        """Return the keys that bounds, pins and frozen gains of a search may name."""
        keys = ({key for each in some.values() for number in each for key in number} for some in self[1:])
        (of_law, others), held = keys, self.own.keys() - self.of_law.keys() - self.others.keys()
        every = of_law | others | (held & search.pins.keys())
        return {"bounds": every, "pins": every, "frozen": every - others}


def _gains(scenario: mc.Scenario, search: Search, law: mc.Law) -> _Gains:
    # with a late force sensor or a servo with friction, which admittance is best depends on the joint loop
    of_gait = {"height": False, "sway": False, "landing_speed": False}
    given = own_parameters(scenario)
    ideal = stages_of(given, scenario.time_step)._replace(**of_gait) == IDEAL and not given.contact.transmits_moments
    joint_gains = not ideal if search.joint_gains is None else search.joint_gains
    integral = INTEGRAL in search.also or (joint_gains and scenario.control.ki > 0)
    gait = [name for name in GAIT if name in search.also or name in search.pins]
    others = [*(JOINT if joint_gains else ()), *((INTEGRAL,) if integral else ()), *gait]
    asked = {*search.also, *(("inertia",) if search.inertia else ())}
    of_law = {
        gain: keys_of(gain, field.shape, search.space)
        for gain, field in law.GAINS.items()
        if field.searched or gain in asked
    }
    return _Gains(own_values(scenario, law) | dict.fromkeys(others, 0.0), of_law, {name: [[name]] for name in others})


def added(law: mc.Law) -> list[str]:
    """Return the names that `also` may have, for a law."""
    return [*law.GAINS, INTEGRAL, *SEARCHED_GAIT]


def named_by(scenario: mc.Scenario, search: Search, law: mc.Law) -> dict[str, set[str]]:
    """Return the gains that bounds, pins and frozen gains of a search may name around a law."""
    return _gains(scenario, search, law).named_by(search)


def signed(field: ValueField | None) -> bool:
    """Return whether a gain may be 0 or less; those of joint loop and gait, which have no field of a law, may not."""
    return field is not None and field.bounds[0] <= 0


def keys_of(gain: str, shape: tuple[int | None, ...], layout: str) -> list[list[str]]:
    """Return the keys of each number of a gain, from the general to the particular; its coordinate has the last."""
    sizes = tuple(size or 1 for size in shape)
    if sizes in ((3,), (6,)):
        depth = 1 + LAYOUTS.index(layout)
        return [[gain, f"{gain}.{PARTS[axis // 3]}", f"{gain}.{SIX[axis]}"][:depth] for axis in range(*sizes)]
    if math.prod(sizes) == 1:
        return [[gain]]
    return [[gain, ".".join([gain, *map(str, place)])] for place in np.ndindex(sizes)]


def _space(
    own: Mapping[str, Any], entries: Mapping[str, list[str | float]], bounds: Mapping[str, tuple[float, float]]
) -> Space:
    """Return the space of gains whose entries are searched, by name, or fixed; their `own` values give their shapes."""
    if not bounds:
        raise ConfigError("", "pins", "a gain left to search", "none")
    fixed = [entry for each in entries.values() for entry in each if not isinstance(entry, str)]
    places = {name: place for place, name in enumerate(bounds)}
    behind, index = itertools.count(len(bounds)), {}
    for gain, each in entries.items():
        found = [places[entry] if isinstance(entry, str) else next(behind) for entry in each]
        index[gain] = np.reshape(found, np.shape(own[gain])).astype(np.int32)
    low, high = np.array(list(bounds.values())).T
    units = np.where(low > 0, 0.0, (high - low) / _UNITS)
    lower, upper = _coordinates(low, units), _coordinates(high, units)
    return Space(tuple(bounds), lower, upper, units, index, np.asarray(fixed, float))


def default_bounds(scenario: mc.Scenario, law: mc.Law) -> dict[str, tuple[float, float]]:
    """Return the bounds of a search whose settings name none: by gain, and `gain.rotation`.

    Joint gains about the scenario's own. The paper's gains where the law has them for HubRobo, and in proportion to its
    mass for a robot from a file; a law that makes bounds of its gains (`search_bounds` of its own) is not scaled.
    """
    control = scenario.control
    joint = {"kp": control.kp, "kd": control.kd or _DAMPED * control.kp}
    bounds = law.search_bounds(scenario.time_step)
    scaled = has_gains_of_the_paper(law) and type(law).search_bounds is mc.Law.search_bounds
    if scaled and isinstance(scenario.robot, RobotFile):
        heavier = float(load_robot(scenario.robot).total_mass / load_robot(_BOUNDED_FOR).total_mass)
        bounds = {name: (low * heavier, high * heavier) for name, (low, high) in bounds.items()}
    return bounds | {name: (joint[name] / below, joint[name] * above) for name, (below, above) in JOINT.items()}


def _integral_bounds(scenario: mc.Scenario) -> dict[str, tuple[float, float]]:
    """Return where searches look for ki, where they do."""
    ki = scenario.control.ki or _PER_KP * scenario.control.kp
    return {INTEGRAL: (ki / _INTEGRAL, ki * _INTEGRAL)}


def _gait_bounds(scenario: mc.Scenario) -> dict[str, tuple[float, float]]:
    """Return where searches look for a gait: stances that keep the order of the swings, half to twice the rest."""
    gait = scenario.gait
    least = gait.duty if gait.phases is not None else 1 - 1 / len(gait.sequence)
    bounds = {name: own_gait(scenario)[name] for name in SEARCHED_GAIT}
    spans = {name: (own / _GAIT_FACTOR, own * _GAIT_FACTOR) for name, own in bounds.items()}
    spans["gait.duty"] = least, max(_LONGEST_STANCE, (1 + least) / 2)
    spans |= {"gait.height": _HEIGHT, "gait.settling": _SHARES, "gait.sway": _SHARES, "gait.landing_speed": _LANDING}
    return spans


def refuse_gait(search: Search) -> None:
    """Refuse by a ConfigError a gait among the gains, where `tune` alone searches one."""
    if gait := gait_of(dict.fromkeys([*search.also, *search.pins])):
        raise ConfigError("", "also", "gains of the law, as tune alone searches a gait", next(iter(gait)))


def check_gait(scenario: mc.Scenario, search: Search) -> None:
    """Refuse a gait that the scenario could not have at the ends of its bounds, or that cannot be searched.

    Raises:
        ConfigError: in one line.
    """
    spans = _gait_bounds(scenario) | search.bounds
    each = {name: spans[name] for name in SEARCHED_GAIT if name in search.also}
    each |= {name: (value, value) for name, value in search.pins.items() if name in GAIT}
    if why := why_fixed(scenario, each):
        raise ConfigError("", "also", reason=why)
    for ends in itertools.product(*each.values()):
        try:
            check_base(scenario_with_gait(scenario, dict(zip(each, ends, strict=True))))
        except ConfigError as error:
            raise error.moved(source="", key=f"bounds.{error.key}") from None


def as_gains(values: Mapping[str, Any]) -> AnyGains:
    """Return gains by name as `mc.Gains` where they are the paper's and the gait is none of them, else as they are."""
    return mc.Gains(**values) if set(values) - {*JOINT, INTEGRAL} == set(mc.Gains.AXES) else values


def own_values(scenario: mc.Scenario, law: mc.Law) -> dict[str, Any]:
    """Return the values of a law's gains by name, each of its full shape.

    A law with the paper's gains has six of each, or leaves those that it has not to the scenario, as `mc.Gains` does.
    """
    own = {n: np.broadcast_to(np.asarray(getattr(law, n), float), field.lengths) for n, field in law.GAINS.items()}
    if not has_gains_of_the_paper(law):
        return own
    whole = {name: np.array(np.broadcast_to(getattr(scenario.control, name), 6), float) for name in mc.Gains.AXES}
    for name, values in own.items():
        whole[name][: values.size] = values
    return whole


def to_gains64(space: Space, theta: Float[np.ndarray, "*batch n"]) -> AnyGains:
    """Return the gains of points in double precision, independent of JAX's setting."""
    return space.to_gains(np.asarray(theta, float))


def follows(scenario: mc.Scenario, joint: Mapping[str, float]) -> bool:
    """Return whether the time step is short enough for joint gains, and their gait where they have one."""
    own = {f"control.{name}": float(joint[name]) for name in JOINT}
    return short_enough(scenario_with_gait(scenario.with_overrides(own), joint))
