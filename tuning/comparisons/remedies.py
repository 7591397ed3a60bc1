"""What keeps grippers from letting go: found by walking again, slower, shorter, with other joint gains."""

import dataclasses

import numpy as np

from mjx_climb.control import Law
from mjx_climb.functions import metrics, rollout
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario


def remedies(scenario: Scenario, detached_at: float, law: Law | None = None) -> str:
    """Return in one line what pulls on the grips of a walk in which one let go, and with which changes less does.

    Walked again with grips that never let go: as it is, with twice the cycle (where the grip let go in the first half
    of the walk), half the stride, joints half and twice as stiff. These are parameters of the compiled walk, so
    that each costs no more than the walk. The first gripper let go at `detached_at` s.
    """
    own, gait, control = own_parameters(scenario), scenario.gait, scenario.control
    changes = {
        "": {},
        f"with gait.cycle={2 * gait.cycle:g}": {"gait.cycle": 2.0},
        f"with gait.stride={gait.stride / 2:g}": {"gait.stride": 0.5},
        f"with control.kp={control.kp / 2:g} and control.kd={control.kd / 2:g}": {"control.kp": 0.5, "control.kd": 0.5},
        f"with control.kp={control.kp * 2:g} and control.kd={control.kd * 2:g}": {"control.kp": 2.0, "control.kd": 2.0},
    }
    if 2 * detached_at > scenario.duration:
        del changes[f"with gait.cycle={2 * gait.cycle:g}"]
    pulls = []
    for change, factors in changes.items():
        changed = own.replace({path: own.at(path) * by for path, by in factors.items()})
        parameters = dataclasses.replace(changed, contact=own.contact.unbreakable())
        try:
            check_time_step(scenario, parameters=parameters)
        except ConfigError:
            continue
        found = metrics(rollout(scenario, parameters=parameters, law=law))
        how = "it diverges" if found["diverged"] else f"{found['peak_pull_force']:.3g} N"
        pulls.append(f"{change} {how}".strip())
    limit = own.values.get("contact.holding_limit")  # of the contact that walks
    bears = "" if limit is None else f"; contact.holding_limit is {f'{limit:g} N' if np.isfinite(limit) else 'null'}"
    return f"pull on grips that never let go: {', '.join(pulls)}{bears}"
