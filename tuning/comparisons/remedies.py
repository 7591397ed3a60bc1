"""Changes that keep grippers shut: less of a gap when they shut; slower and shorter walks, other joint gains."""

import dataclasses

import numpy as np

from mjx_climb.control import Law
from mjx_climb.functions import metrics, rollout
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import GRIPS, METRICS

_NAMED = 0.5  # of the largest pull: a gap that makes as much is named
GAP = ("grip_gap", "peak_pull_force", "missed_grips")  # metrics that `gap_in_words` reads


def gap_in_words(scenario: Scenario, gap: float, pull: float, missed: float) -> str:
    """Return in words the pull, or the miss, of a gap of feet whose grippers shut, and its remedies; "" of a small one.

    Arguments:
        gap: m, the largest.
        pull: N, the largest of the walk.
        missed: number of grips that missed the ground.
    """
    stiffness, closing = scenario.value("contact.stiffness", 0.0), scenario.value("contact.closing_time", 0.0)
    snaps = not closing and stiffness * gap >= _NAMED * pull > 0
    if not (missed or snaps):
        return ""
    reach = scenario.value("contact.capture_distance")
    what = f"a foot is {1e3 * gap:.2g} mm off the ground when its gripper shuts"
    if missed and reach is not None:
        what += f", contact.capture_distance is {1e3 * reach:.2g} mm"
    elif snaps:
        what += f", which pulls {stiffness * gap:.3g} N at once without a contact.closing_time"
    return f"{what}: raise control.kp, set gait.landing_speed, or lower gait.height"


def remedies(scenario: Scenario, detached_at: float, law: Law | None = None) -> str:
    """Return in one line the pull on the grips of a walk that lost one, and changes that make it less.

    A gap that feet have when their grippers shut comes first.

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
    pulls, gap = [], ""
    for change, factors in changes.items():
        changed = own.replace({path: own.at(path) * by for path, by in factors.items()})
        parameters = dataclasses.replace(changed, contact=own.contact.unbreakable())
        try:
            check_time_step(scenario, parameters=parameters)
        except ConfigError:
            continue
        found = metrics(rollout(scenario, parameters=parameters, law=law), METRICS + GRIPS)
        if not change:
            gap = gap_in_words(scenario, *(float(found[name] or 0) for name in GAP))
        how = "it diverges" if found["diverged"] else f"{found['peak_pull_force']:.3g} N"
        pulls.append(f"{change} {how}".strip())
    limit = own.values.get("contact.holding_limit")  # of the contact that walks
    bears = "" if limit is None else f"; contact.holding_limit is {f'{limit:g} N' if np.isfinite(limit) else 'null'}"
    text = f"pull on grips that never let go: {', '.join(pulls)}{bears}"
    return f"{gap}; {text}" if gap else text
