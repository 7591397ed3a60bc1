"""What keeps grippers from letting go: found by walking again, slower, shorter, with other joint gains."""

import dataclasses
import math

import numpy as np

from mjx_climb.checks.time_step import check_time_step
from mjx_climb.control import Law
from mjx_climb.quantities.parameters import own_parameters
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.functions import metrics, rollout, rollout_metrics
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario

SLOWER = ((1.0,), (2.0, 4.0, 4.0))  # times the cycle, walked together; the third with grips that never let go


def slow_enough(scenario: Scenario) -> tuple[Scenario, bool, str]:
    """Return a scenario with its cycle, or twice or four times that, whichever is the first at which it walks.

    It walks where all grips hold and the base strays by no more than half its height.

    Returns:
        The scenario, two cycles long, whether it walks, and in words how it went: where none does, what fails although
        the slowest one has grips that never let go.
    """
    own, cycle, robot = own_parameters(scenario), scenario.gait.cycle, load_robot(scenario.robot)
    for times in SLOWER:
        cycles, endless = cycle * np.array(times), np.arange(len(times)) == 2
        walks = dataclasses.replace(own, cycle=cycles, holding_limit=np.where(endless, math.inf, own.holding_limit))
        span = 2 * float(cycles[0])
        walked = rollout_metrics(scenario.with_overrides({"duration": span}), parameters=walks, dtype=np.float64)
        upright = ~walked["diverged"] & (walked["base_deviation"] < robot.stance_position[2] / 2)
        held = upright & (walked["detached_limb"] < 0) & ~endless
        if held.any():
            found = float(cycles[np.argmax(held)])
            slower = "" if found == cycle else f", which it does not at {found / 2:g} s"
            scenario = scenario.with_overrides({"gait.cycle": found, "duration": 2 * found})
            return scenario, True, f"holds for {span:g} s at a cycle of {found:g} s{slower}"
    if upright[-1]:
        limb = robot.limbs[int(walked["detached_limb"][-2])]
        pull, limit = walked["peak_pull_force"][-1], scenario.contact.holding_limit
        why = f"limb {limb} lets go; a grip that held would pull {pull:.3g} N, contact.holding_limit is {limit:g} N"
    elif walked["diverged"][-1]:
        why = "diverges, with grips that never let go too: see stance, joint limits and control"
    else:
        strays = walked["base_deviation"][-1]
        why = f"its base strays {strays:.3g} m, with grips that never let go too: see control.kp and torque limits"
    return scenario, False, f"does not walk at any cycle from {cycle:g} to {cycles[-1]:g} s: {why}"


def remedies(scenario: Scenario, detached_at: float, law: Law | None = None) -> str:
    """Return in one line what pulls on the grips of a walk in which one let go, and with which changes less does.

    Walked again with grips that never let go: as it is, with twice the cycle (where the grip let go in the first half
    of the walk), half the stride, joints half and twice as stiff. These are parameters of the compiled walk, so
    that each costs no more than the walk. The first gripper let go at `detached_at` s.
    """
    own, gait, control = own_parameters(scenario), scenario.gait, scenario.control
    changes = {
        "": {},
        f"with gait.cycle={2 * gait.cycle:g}": {"cycle": 2.0},
        f"with gait.stride={gait.stride / 2:g}": {"stride": 0.5},
        f"with control.kp={control.kp / 2:g} and control.kd={control.kd / 2:g}": {"kp": 0.5, "kd": 0.5},
        f"with control.kp={control.kp * 2:g} and control.kd={control.kd * 2:g}": {"kp": 2.0, "kd": 2.0},
    }
    if 2 * detached_at > scenario.duration:
        del changes[f"with gait.cycle={2 * gait.cycle:g}"]
    pulls = []
    for change, factors in changes.items():
        changed = {name: getattr(own, name) * by for name, by in factors.items()}
        parameters = dataclasses.replace(own, holding_limit=np.array(math.inf), **changed)
        try:
            check_time_step(scenario, parameters=parameters)
        except ConfigError:
            continue
        found = metrics(rollout(scenario, parameters=parameters, law=law))
        how = "it diverges" if found["diverged"] else f"{found['peak_pull_force']:.3g} N"
        pulls.append(f"{change} {how}".strip())
    limit = scenario.contact.holding_limit
    return f"pull on grips that never let go: {', '.join(pulls)}; contact.holding_limit is {limit:g} N"
