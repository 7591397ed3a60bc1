"""Spaces of gains: which numbers a search moves, in which bounds, and the gains that they stand for.

A point theta holds natural logarithms, so every gain is positive. Names of its coordinates: `damping` and
`stiffness` where all axes share a gain; `damping.translation`, `damping.rotation`; or `damping.x`, .. `damping.rz`;
likewise `inertia`; and `kp`, `kd`.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.files.dataset import SIX
from mjx_climb.quantities.parameters import gains as gains_of
from mjx_climb.scenario.messages import ConfigError
from tuning.problem.search import Search

SIX_AXES = ("inertia", "damping", "stiffness")
JOINT = ("kp", "kd")
PARTS = ("translation", "rotation")

# kg, N s/m, N/m; kg m^2, N m s/rad, N m/rad; N m/rad; N m s/rad. A rotation's gain is about a lever squared, 0.04 m^2,
# times that of a translation with the same effect at the feet.
BOUNDS: dict[str, tuple[float, float]] = {
    "inertia": (1e-1, 1e2),
    "damping": (1e0, 1e5),
    "stiffness": (1e2, 1e6),
    "inertia.rotation": (1e-2, 1e1),
    "damping.rotation": (1e-1, 1e4),
    "stiffness.rotation": (1e1, 1e5),
    "kp": (10.0, 200.0),
    "kd": (0.02, 2.0),
}


@dataclasses.dataclass(frozen=True)
class Space:
    """A box of log gains, and the map from it to gains."""

    names: tuple[str, ...]  # of the n coordinates
    lower: np.ndarray  # (n,) natural logarithm of the bounds
    upper: np.ndarray
    index: dict[str, np.ndarray]  # gain: which entries of [theta, log of the fixed values] make it, (6,) or ()
    fixed: np.ndarray  # (m,) natural logarithm of what is not searched

    @property
    def size(self) -> int:
        """How many numbers are searched."""
        return len(self.names)

    def to_gains(self, theta: Float[Array, "*batch n"]) -> mc.Gains:
        """Return the gains of points, with their batch axes."""
        fixed = jnp.broadcast_to(jnp.asarray(self.fixed, theta.dtype), (*theta.shape[:-1], self.fixed.size))
        values = jnp.exp(jnp.concatenate([theta, fixed], axis=-1))
        return mc.Gains(**{name: values[..., index] for name, index in self.index.items()})

    def from_gains(self, gains: mc.Gains) -> np.ndarray:
        """Return the point (n,) nearest to some gains: geometric means of shared ones, clipped to the bounds."""
        theta = np.zeros(self.size)
        for name, index in self.index.items():
            value = getattr(gains, name)
            if value is None:
                continue
            logs = np.broadcast_to(np.log(np.asarray(value, float)), np.shape(index))
            for place in np.unique(index[index < self.size]):
                theta[place] = logs[index == place].mean()
        return self.clip(theta)

    def clip(self, theta: np.ndarray) -> np.ndarray:
        """Return the nearest points inside the bounds."""
        return np.asarray(np.clip(theta, self.lower, self.upper))

    @property
    def ties(self) -> np.ndarray:
        """Which coordinates are the same gain of different axes: (k, n), one row of zeros and ones per gain."""
        kinds = [name.split(".")[0] for name in self.names]
        return np.array([[float(kind == own) for kind in kinds] for own in dict.fromkeys(kinds)])

    def draw_tied(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return points (count, n) whose axes have the same gains, as far as the bounds let them: a hypercube too."""
        ties = self.ties
        low = np.array([self.lower[row > 0].max() for row in ties])
        high = np.array([self.upper[row > 0].min() for row in ties])
        return self.clip(_hypercube(rng, count, low, np.maximum(low, high)) @ ties)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return points (count, n), a Latin hypercube."""
        return _hypercube(rng, count, self.lower, self.upper)

    def on_bound(self, theta: np.ndarray, tolerance: float = 1e-3) -> list[str]:
        """Return the names of the gains that lie on a bound."""
        reach = tolerance * (self.upper - self.lower)
        beside = (theta - self.lower <= reach) | (self.upper - theta <= reach)
        return [name for name, on in zip(self.names, beside, strict=True) if on]


def space(scenario: mc.Scenario, search: Search) -> Space:
    """Return the space that the settings ask for around a scenario's own gains.

    Raises:
        ConfigError: bounds or pins of a gain that is not there, a controller without gains, nothing left to search.
    """
    control = scenario.control
    if control.controller == "pd" and not search.joint_gains:
        raise ConfigError("control.controller: expected an admittance law, got pd, which has no gains to search")
    own, defaults = gains_of(scenario), default_bounds(scenario)
    wanted = [*(("inertia",) if search.inertia else ()), "damping", "stiffness"]
    if control.controller == "pd":
        wanted = []
    translations_only = control.controller == "end_effector_admittance"
    known = {"kp", "kd"} if search.joint_gains else set()
    names, lower, upper, fixed = [], [], [], []
    places: dict[str, int | list[int]] = {}

    def add(name: str, keys: list[str]) -> int:
        """Place one number; keys go from the general to the particular."""
        known.update(keys)
        pinned = [search.pins[key] for key in keys if key in search.pins]
        if pinned:
            fixed.append(np.log(pinned[-1]))
            return -len(fixed)
        low, high = _bounds(keys, search, defaults)
        names.append(name)
        lower.append(np.log(low))
        upper.append(np.log(high))
        return len(names) - 1

    def keep(value: float) -> int:
        fixed.append(np.log(value))
        return -len(fixed)

    for gain in SIX_AXES:
        values = np.broadcast_to(np.asarray(getattr(own, gain), float), 6)
        if gain not in wanted:
            if gain in search.pins:
                known.add(gain)
                values = np.full(6, search.pins[gain])
            places[gain] = [keep(value) for value in values]
        elif search.space == "isotropic":
            places[gain] = [add(gain, [gain])] * 6
        elif search.space == "split":
            pair = [add(f"{gain}.{part}", [gain, f"{gain}.{part}"]) for part in PARTS[: 2 - translations_only]]
            places[gain] = [pair[0]] * 3 + ([keep(v) for v in values[3:]] if translations_only else [pair[1]] * 3)
        else:
            places[gain] = [
                keep(values[axis])
                if translations_only and axis > 2
                else add(f"{gain}.{SIX[axis]}", [gain, f"{gain}.{PARTS[axis // 3]}", f"{gain}.{SIX[axis]}"])
                for axis in range(6)
            ]
    if search.joint_gains:
        for gain in JOINT:
            places[gain] = add(gain, [gain])
    for section in ("bounds", "pins"):
        for key in getattr(search, section):
            if key not in known:
                raise ConfigError(f"{section}.{key}: expected one of {', '.join(sorted(known))}")
    if not names:
        raise ConfigError("pins: expected a gain left to search, got none")
    count = len(names)
    index = {
        gain: np.asarray([p if p >= 0 else count - 1 - p for p in np.ravel(place)], np.int32).reshape(np.shape(place))
        for gain, place in places.items()
    }
    return Space(tuple(names), np.asarray(lower), np.asarray(upper), index, np.asarray(fixed, float))


def to_gains64(space: Space, theta: Float[np.ndarray, "*batch n"]) -> mc.Gains:
    """Return the gains of points in double precision, whatever JAX is set to."""
    with jax.enable_x64(True):
        gains: mc.Gains = jax.tree.map(np.asarray, space.to_gains(jnp.asarray(theta)))
        return gains


def _hypercube(rng: np.random.Generator, count: int, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    strata = np.argsort(rng.random((lower.size, count)), axis=1).T
    return np.asarray(lower + (upper - lower) * (strata + rng.random((count, lower.size))) / count)


def _bounds(keys: list[str], search: Search, defaults: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Return the bounds of a gain: the user's before the defaults, each from the particular key to the general."""
    return next(source[key] for source in (search.bounds, defaults) for key in reversed(keys) if key in source)


def default_bounds(scenario: mc.Scenario) -> dict[str, tuple[float, float]]:
    """Return the bounds by key: `BOUNDS`, and for the measured pose what its time step makes of the gains.

    There one step takes the shares dt D / M of the rate and dt^2 K / M of the offset out of the target; the base is
    held only by shares of the order of one.
    """
    if scenario.control.reading != "measured_pose":
        return BOUNDS
    mass = float(np.exp(np.log(scenario.control.inertia).mean()))
    step = scenario.time_step
    return {
        **{key: BOUNDS[key] for key in ("inertia", "inertia.rotation", *JOINT)},
        "damping": (mass / step, 1e2 * mass / step),
        "stiffness": (1e-2 * mass / step**2, mass / step**2),
    }
