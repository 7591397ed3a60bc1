"""The first walks of a proposed scenario: its joint gains, the cycle at which it holds, its limit on a ceiling.

All of them are the walks of one compiled program, `WALKS` side by side, which differ by their parameters alone. Their
grips never let go: they hold where none uses more than its limit, under any contact.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_climb.functions import rollout_metrics
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.parameter_types import Gains
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import Scenario
from mjx_climb.scenario.values import G
from mjx_climb.walk.metrics import GRIPS, METRICS
from tuning.comparisons.remedies import GAP, gap_in_words
from tuning.problem.evaluation import RIGID
from tuning.problem.spaces import JOINT, follows

_LIMIT = "contact.holding_limit"  # of contacts that have one
WALKS = 16
SLOWER = ((1.0,), (2.0, 4.0))  # times the cycle, walked together
ROUNDS = 3  # grids of kp and kd, each about the best of the one before and half as wide
LONG = 100_000  # time steps of a walk from which on one grid must do
STEP_TIME = 1e-6  # s on one core, of a time step of one joint of one walk
GRID, TIMES = (5, 3), (5.0, 10.0)  # values of kp and kd; the first grid goes so many times lower and higher
SAGS = 0.1  # of the stance's height: how far the base may stray for less force variation
MANY = 2.0  # times the robot's weight on Earth, in a single foot: worth a warning


Told = Callable[[int], None]  # takes how many more walks are done


def expected(scenario: Scenario) -> tuple[int, float]:
    """Return how many walks a scenario gets where it holds at its own cycle, and the seconds they take on one core."""
    grids, joints = _grids(scenario), load_robot(scenario.robot).joint_lower.size
    batches = grids + 1
    seconds = batches * WALKS * joints * _steps(scenario) * STEP_TIME
    return grids * math.prod(GRID) + len(SLOWER[0]) + 1, seconds


def _steps(scenario: Scenario) -> int:
    return round(scenario.duration / scenario.time_step)


def _grids(scenario: Scenario) -> int:
    return 1 if _steps(scenario) > LONG else ROUNDS


class FirstWalk(NamedTuple):
    """A scenario, two cycles long, and how its walk went."""

    scenario: Scenario
    holds: bool
    how: str
    peak_foot_force: float  # N
    # metrics of the same walk on a ceiling, (1,) each, where it has walked
    hung: Mapping[str, np.ndarray] = MappingProxyType({})


def _walked(
    scenario: Scenario, values: Mapping[str, ArrayLike], *, rigid: bool = False, smooth: bool = True
) -> dict[str, np.ndarray]:
    """Return the metrics of walks with other values at some paths, one or (N, ...) each, N up to `WALKS`.

    `upright`: which keep near their reference; `holds`: whose grips reach the ground and hold besides. With `rigid`
    under pd, in place of the scenario's gains. Grips that are not `smooth` let go.
    """
    own, control, robot = own_parameters(scenario), scenario.control, load_robot(scenario.robot)
    varied = {path: own.at(path) for path in ("control.kp", "control.kd", "gait.cycle", "gravity")} | dict(values)
    fields = own.paths
    count = max(np.size(value) // fields[path].size for path, value in varied.items())
    padded = {path: np.resize(value, (WALKS, *fields[path].lengths)) for path, value in varied.items()}
    gains = (RIGID if rigid else control.inertia), control.damping, control.stiffness
    walked = rollout_metrics(
        scenario,
        Gains(*(np.broadcast_to(np.asarray(gain, float), (WALKS, 6)) for gain in gains)),
        own.replace(padded),
        metrics=METRICS + GRIPS,
        dtype=np.float64,
        smooth=smooth,
        unsteady=True,  # gains that the time step cannot follow lose the comparison
    )
    found = {name: np.asarray(value)[:count] for name, value in walked.items()}
    upright = ~found["diverged"].astype(bool) & (found["base_deviation"] < robot.stance_position[2] / 2)
    grips = (found["missed_grips"] == 0) & (found["peak_utilization"] <= 1)
    return found | {"upright": upright, "holds": upright & grips}


def with_joint_gains(scenario: Scenario, told: Told = lambda _: None) -> tuple[Scenario, str]:
    """Return a scenario with the kp and kd that give pd the least force variation, and their effect in words.

    Walked with grips that never let go, over the scenario's duration; among gains that its time step can follow, with
    which all grippers reach the ground and the base strays no farther than a tenth of its height, or than with the
    scenario's own. The first grid lies about these, each other one about the best of the one before. A walk of more
    than `LONG` time steps takes minutes: then one grid must do.
    """
    control, size, grids = scenario.control, math.prod(GRID), _grids(scenario)
    offsets = np.stack(np.meshgrid(*(np.linspace(-1, 1, count) for count in GRID)), -1).reshape(-1, 2) * np.log(TIMES)
    allowed, first = SAGS * load_robot(scenario.robot).stance_position[2], math.inf
    best = np.log([control.kp, control.kd])
    for number in range(grids):
        points = np.vstack([best + 0.5**number * offsets, best])
        kp, kd = np.exp(points).T
        walked = _walked(scenario, {"control.kp": kp, "control.kd": kd}, rigid=True)
        told(size)
        if number == 0 and walked["upright"][-1]:  # the last are the scenario's own
            first, allowed = float(walked["force_variation"][-1]), max(allowed, float(walked["base_deviation"][-1]))
        good = walked["upright"] & (walked["base_deviation"] <= allowed) & (walked["missed_grips"] == 0)
        values = np.where(good, walked["force_variation"], np.inf)
        joints = [{n: float(f"{gain:.2g}") for n, gain in zip(JOINT, np.exp(point), strict=True)} for point in points]
        ranked = [place for place in np.argsort(values, kind="stable") if np.isfinite(values[place])]
        if (place := next((place for place in ranked if follows(scenario, joints[place])), None)) is None:
            return scenario, "no others among those searched keep the base as near to its reference"
        best, joint, value = points[place], joints[place], float(values[place])
    if not value < first * (1 - 1e-9):
        return scenario, f"none of {grids * size - 1} others gives pd less force variation"
    before = f"with kp {control.kp:g} and kd {control.kd:g}, HubRobo's in proportion"
    less = f"{100 * (1 - value / first):.0f} % less than" if np.isfinite(first) else "which does not walk"
    changed = scenario.with_overrides({f"control.{name}": gain for name, gain in joint.items()})
    return changed, f"of {grids * size} short walks of pd that of least force variation, {less} {before}"


def slow_enough(scenario: Scenario, told: Told = lambda _: None) -> FirstWalk:
    """Return a scenario with its cycle, or twice or four times that, whichever is the first at which it walks.

    It walks where all grippers reach the ground, all grips hold and the base strays by no more than half its height.
    Where it does at none, the words say why the slowest one fails. Walks on a ceiling fill the same batch.
    """
    cycle, gravity = scenario.gait.cycle, [scenario.gravity, _upwards(scenario)]
    for times in SLOWER:
        cycles = cycle * np.array(times)
        span = 2 * float(cycles[0])
        longer = scenario.with_overrides({"duration": span})
        both = {"gait.cycle": np.tile(cycles, 2), "gravity": np.repeat(gravity, len(times), axis=0)}
        every = _walked(longer, both)
        told(len(times))
        walked = {name: value[: len(times)] for name, value in every.items()}
        if walked["holds"].any():
            place = int(np.argmax(walked["holds"]))
            found = float(cycles[place])
            # of slower ones two cycles are longer than this walk
            hung = {} if place else {name: value[len(times) :][:1] for name, value in every.items()}
            slower = "" if found == cycle else f", which it does not at {found / 2:g} s"
            scenario = scenario.with_overrides({"gait.cycle": found, "duration": 2 * found})
            how = f"holds for {span:g} s at a cycle of {found:g} s{slower}"
            return FirstWalk(scenario, True, how, float(walked["peak_foot_force"][place]), hung)
    broken = _walked(longer, {"gait.cycle": cycles[-1]}, smooth=False)
    if walked["upright"][-1] and broken["detached_limb"][0] >= 0:
        why = f"limb {_detached(scenario, broken)} lets go; a grip that held would pull {_pulled(scenario, walked)}"
    elif walked["upright"][-1] or broken["missed_grips"][0]:
        why = f"{broken['missed_grips'][0]} grips miss the ground"
    elif walked["diverged"][-1]:
        why = "diverges, with grips that never let go too: see stance, joint limits and control"
    else:
        strays = walked["base_deviation"][-1]
        why = f"its base strays {strays:.3g} m, with grips that never let go too: see control.kp and torque limits"
    if gap := _gap(scenario, broken):
        why = f"{gap}; {why}"
    how = f"does not walk at any cycle from {cycle:g} to {cycles[-1]:g} s: {why}"
    return FirstWalk(scenario, False, how, math.nan)


def _pulled(scenario: Scenario, walked: Mapping[str, np.ndarray]) -> str:
    """Return the pull of the last walk on its grips, and the limit of the contact where that is one number."""
    limit = own_parameters(scenario).values.get(_LIMIT)
    bears = "" if limit is None or np.ndim(limit) else f", {_LIMIT} is {float(limit):g} N"
    return f"{walked['peak_pull_force'][-1]:.3g} N, {walked['peak_utilization'][-1]:.3g} times its limit{bears}"


def _detached(scenario: Scenario, broken: Mapping[str, np.ndarray]) -> str:
    """Return the limb that lets go in a walk."""
    return load_robot(scenario.robot).limbs[int(broken["detached_limb"][0])]


def _gap(scenario: Scenario, broken: Mapping[str, np.ndarray]) -> str:
    """Return in words the effect of the gap of a walk when grippers shut, "" where it matters not."""
    return gap_in_words(scenario, *(float(broken[name][0]) for name in GAP))


def _upwards(scenario: Scenario) -> list[float]:
    """Return the gravity on a ceiling."""
    return [0.0, 0.0, float(np.linalg.norm(scenario.gravity))]


def on_ceiling(
    scenario: Scenario, told: Told = lambda _: None, hung: Mapping[str, np.ndarray] = MappingProxyType({})
) -> tuple[bool, str]:
    """Return whether a walk holds on a ceiling, and in words the holding limit with which it would hold there.

    It is the largest pull on grips that never let go, rounded up: any limit above that changes nothing in the walk.
    `hung` are the metrics of that walk, where it has walked.
    """
    upwards = {"gravity": _upwards(scenario)}
    walked = hung or _walked(scenario, upwards)
    told(1)
    pull, robot = float(walked["peak_pull_force"][0]), load_robot(scenario.robot)
    # it hangs away from the ground, as far as the limbs hold the base
    away = np.linalg.norm(limb_frames(robot, None, robot.stance_joints).foot, axis=-1).mean()
    if walked["diverged"][0] or not walked["base_deviation"][0] < away / 2:
        how = "diverges" if walked["diverged"][0] else f"its base strays {walked['base_deviation'][0]:.3g} m"
        return False, f"{how} there, with grips that never let go too: see control.kp and torque limits"
    missed = bool(walked["missed_grips"][0])
    if not missed and walked["peak_utilization"][0] <= 1:
        return True, f"holds there too: the largest pull is {pull:.3g} N"
    broken = _walked(scenario, upwards, smooth=False)
    gap = _gap(scenario, broken)
    if missed:
        return False, f"{gap}: it does not reach the ground there"
    lets_go = "; ".join(filter(None, [gap, f"limb {_detached(scenario, broken)} lets go there"]))
    if _LIMIT not in own_parameters(scenario).paths:
        return False, f"{lets_go}; a grip that held would pull {_pulled(scenario, walked)}"
    power = 10.0 ** (math.floor(math.log10(pull)) - 1)
    needed = float(f"{math.ceil(pull / power + 1e-9) * power:.2g}")
    return False, f"{lets_go}; {_LIMIT}={needed:g} would hold"


def heavy_load(scenario: Scenario, peak_foot_force: float) -> str | None:
    """Return in words a load on one foot that is many times the robot's weight on Earth; None of one that is not."""
    weight = G * float(load_robot(scenario.robot).total_mass)
    if not peak_foot_force > MANY * weight:
        return None
    times = f"{peak_foot_force / weight:.2g} times its weight on Earth"
    return f"{peak_foot_force:.3g} N on one foot, {times}: are a real robot's joints and grips as strong?"
