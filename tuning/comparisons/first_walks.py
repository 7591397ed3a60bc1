"""The first walks of a proposed scenario: its joint gains, the cycle at which it holds, and what a ceiling asks of it.

All of them are the walks of one compiled program, `WALKS` side by side, which differ by their parameters alone.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from mjx_climb.functions import rollout_metrics
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.parameter_types import Gains
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import GRIPS, METRICS
from tuning.comparisons.remedies import GAP, gap_in_words
from tuning.problem.evaluation import RIGID
from tuning.searches.retuned_pd import Grids, closer

_LIMIT = "contact.holding_limit"
WALKS = 16
SLOWER = ((1.0,), (2.0, 4.0, 4.0))  # times the cycle, walked together; the third with grips that never let go
ROUNDS = 3  # grids of kp and kd, each about the best of the one before and half as wide
ON_CEILING = 2  # walks there
LONG = 100_000  # time steps of a walk from which on one grid must do
STEP_TIME = 1e-6  # s on one core, of a time step of one joint of one walk
GRID, TIMES = (5, 3), (5.0, 10.0)  # values of kp and kd; the first grid goes so many times lower and higher
SAGS = 0.1  # of the stance's height, what the base may stray for less force variation
MANY = 2.0  # times the robot's weight on Earth, in a single foot: worth a warning
EARTH = 9.81  # m/s^2


Told = Callable[[int], None]  # takes how many more walks are done


def expected(scenario: Scenario) -> tuple[int, float]:
    """Return how many walks a scenario gets where it holds at its own cycle, and the seconds they take on one core."""
    grids, joints = _grids(scenario), load_robot(scenario.robot).joint_lower.size
    batches = grids + len(SLOWER[0]) + 1
    seconds = batches * WALKS * joints * _steps(scenario) * STEP_TIME
    return grids * math.prod(GRID) + len(SLOWER[0]) + ON_CEILING, seconds


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


def _walked(
    scenario: Scenario, values: Mapping[str, np.ndarray | float], *, rigid: bool = False
) -> dict[str, np.ndarray]:
    """Return the metrics of walks with other values at some paths, (N,) each, N up to `WALKS`, and which stay upright.

    With `rigid` under pd, whatever the scenario's gains.
    """
    own, control, robot = own_parameters(scenario), scenario.control, load_robot(scenario.robot)
    count = max(map(np.size, values.values()))
    paths = ("control.kp", "control.kd", "gait.cycle", *([_LIMIT] if _LIMIT in own.paths else []))
    varied = {path: own.at(path) for path in paths} | dict(values)
    padded = {path: np.resize(value, WALKS) for path, value in varied.items() if path != "gravity"}
    padded["gravity"] = np.broadcast_to(values.get("gravity", own.gravity), (WALKS, 3))
    inertia, damping, stiffness = (
        np.broadcast_to(np.asarray(gain, float), (WALKS, 6))
        for gain in (RIGID if rigid else control.inertia, control.damping, control.stiffness)
    )
    walked = rollout_metrics(
        scenario,
        Gains(inertia, damping, stiffness),
        own.replace(padded),
        metrics=METRICS + GRIPS,
        dtype=np.float64,
        unsteady=True,  # gains that the time step cannot follow lose the comparison
    )
    found = {name: np.asarray(value)[:count] for name, value in walked.items()}
    return found | {"upright": ~found["diverged"] & (found["base_deviation"] < robot.stance_position[2] / 2)}


def with_joint_gains(scenario: Scenario, told: Told = lambda _: None) -> tuple[Scenario, str]:
    """Return a scenario with the kp and kd that give pd the least force variation, and in words what they change.

    Walked with grips that never let go, over the scenario's duration; among gains that its time step can follow, with
    which all grippers reach the ground and the base strays no farther than a tenth of its height, or than with the
    scenario's own. A walk of more than
    `LONG` time steps takes minutes: then one grid must do.
    """
    control, size = scenario.control, math.prod(GRID)
    own, grids, first = np.log([control.kp, control.kd]), _grids(scenario), None
    allowed, count = SAGS * load_robot(scenario.robot).stance_position[2], grids * size

    def values(joint: Mapping[str, np.ndarray]) -> np.ndarray:
        nonlocal first, allowed
        walked = _walked(scenario, {"control.kp": joint["kp"], "control.kd": joint["kd"], _LIMIT: math.inf}, rigid=True)
        told(size)
        if first is None:  # the last are the scenario's own
            upright = walked["upright"][-1]
            first = float(walked["force_variation"][-1]) if upright else math.inf
            allowed = max(allowed, float(walked["base_deviation"][-1]) if upright else 0.0)
        good = walked["upright"] & (walked["base_deviation"] <= allowed) & (walked["missed_grips"] == 0)
        return np.where(good, walked["force_variation"], np.inf)

    found = closer(scenario, values, Grids(own, np.log(TIMES), GRID, grids, 0.5), digits=2)
    if found is None:
        return scenario, "no others among those searched keep the base as near to its reference"
    joint, value = found
    assert first is not None
    if not value < first * (1 - 1e-9):
        return scenario, f"none of {count - 1} others gives pd less force variation"
    before = f"with kp {control.kp:g} and kd {control.kd:g}, HubRobo's in proportion"
    less = f"{100 * (1 - value / first):.0f} % less than" if np.isfinite(first) else "which does not walk"
    changed = scenario.with_overrides({f"control.{name}": gain for name, gain in joint.items()})
    return changed, f"of {count} short walks of pd that of least force variation, {less} {before}"


def slow_enough(scenario: Scenario, told: Told = lambda _: None) -> FirstWalk:
    """Return a scenario with its cycle, or twice or four times that, whichever is the first at which it walks.

    It walks where all grippers reach the ground, all grips hold and the base strays by no more than half its height.
    Where it does at none, the words say what fails although the slowest one has grips that never let go.
    """
    own, cycle, robot = own_parameters(scenario), scenario.gait.cycle, load_robot(scenario.robot)
    for times in SLOWER:
        cycles, endless = cycle * np.array(times), np.arange(len(times)) == 2
        span = 2 * float(cycles[0])
        limits = np.where(endless, math.inf, own.contact.holding_limit)
        walked = _walked(scenario.with_overrides({"duration": span}), {"gait.cycle": cycles, _LIMIT: limits})
        told(len(times))
        held = walked["upright"] & (walked["detached_limb"] < 0) & (walked["missed_grips"] == 0) & ~endless
        if held.any():
            found = float(cycles[np.argmax(held)])
            slower = "" if found == cycle else f", which it does not at {found / 2:g} s"
            scenario = scenario.with_overrides({"gait.cycle": found, "duration": 2 * found})
            how = f"holds for {span:g} s at a cycle of {found:g} s{slower}"
            return FirstWalk(scenario, True, how, float(walked["peak_foot_force"][np.argmax(held)]))
    if walked["upright"][-1] and walked["detached_limb"][-2] >= 0:
        limb = robot.limbs[int(walked["detached_limb"][-2])]
        pull, limit = walked["peak_pull_force"][-1], scenario.value(_LIMIT, math.inf)
        why = f"limb {limb} lets go; a grip that held would pull {pull:.3g} N, contact.holding_limit is {limit:g} N"
    elif walked["upright"][-1]:
        why = f"{walked['missed_grips'][-2]} grips miss the ground"
    elif walked["diverged"][-1]:
        why = "diverges, with grips that never let go too: see stance, joint limits and control"
    else:
        strays = walked["base_deviation"][-1]
        why = f"its base strays {strays:.3g} m, with grips that never let go too: see control.kp and torque limits"
    if gap := _gap(scenario, walked, -2):
        why = f"{gap}; {why}"
    how = f"does not walk at any cycle from {cycle:g} to {cycles[-1]:g} s: {why}"
    return FirstWalk(scenario, False, how, math.nan)


def _gap(scenario: Scenario, walked: Mapping[str, np.ndarray], number: int) -> str:
    """Return in words what the gap of a walk does when grippers shut, "" where it matters not."""
    return gap_in_words(scenario, *(float(walked[name][number]) for name in GAP))


def on_ceiling(scenario: Scenario, told: Told = lambda _: None) -> tuple[bool, str]:
    """Return whether a walk holds on a ceiling, and in words the holding limit with which it would hold there.

    It is the largest pull on grips that never let go, rounded up: any limit above that changes nothing in the walk.
    """
    strength, own = float(np.linalg.norm(scenario.gravity)), scenario.value(_LIMIT, math.inf)
    limit, gravity = math.inf if own is None else own, np.array([0.0, 0.0, strength])
    walked = _walked(scenario, {"gravity": gravity, _LIMIT: np.array([limit, math.inf])})
    told(ON_CEILING)
    pull = float(walked["peak_pull_force"][1])
    robot = load_robot(scenario.robot)
    # it hangs away from the ground: what counts is how far the limbs hold the base
    away = np.linalg.norm(limb_frames(robot, None, robot.stance_joints).foot, axis=-1).mean()
    if walked["diverged"][1] or not walked["base_deviation"][1] < away / 2:
        how = "diverges" if walked["diverged"][1] else f"its base strays {walked['base_deviation'][1]:.3g} m"
        return False, f"{how} there, with grips that never let go too: see control.kp and torque limits"
    gap = _gap(scenario, walked, 0)
    if walked["missed_grips"][0]:
        return False, f"{gap}: it does not reach the ground there"
    if walked["detached_limb"][0] < 0:
        return True, f"holds there too: the largest pull is {pull:.3g} N"
    power = 10.0 ** (math.floor(math.log10(pull)) - 1)
    needed = float(f"{math.ceil(pull / power + 1e-9) * power:.2g}")
    limb = robot.limbs[int(walked["detached_limb"][0])]
    first = f"{gap}; " if gap else ""
    return False, f"{first}limb {limb} lets go there; contact.holding_limit={needed:g} would hold"


def heavy_load(scenario: Scenario, peak_foot_force: float) -> str | None:
    """Return in words a load on one foot that is many times the robot's weight on Earth; None of one that is not."""
    weight = EARTH * float(load_robot(scenario.robot).total_mass)
    if not peak_foot_force > MANY * weight:
        return None
    times = f"{peak_foot_force / weight:.2g} times its weight on Earth"
    return f"{peak_foot_force:.3g} N on one foot, {times}: are a real robot's joints and grips as strong?"
