"""What the paper states of its three cases, and whether walks of ours bear it out.

M. Imai, K. Uno, K. Yoshida, "Admittance control-based floating base reaction mitigation for limbed climbing robots".

A claim is a function of two walks, the baseline's and the proposed controller's, and of what is published for the case.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

import mjx_climb as mc

UNCHANGED = 0.005  # a smaller relative change is none
SETTLED = 0.02  # s after a grip change: what it did to the joints' targets is over


class Case(NamedTuple):
    """A case of the paper and what it publishes in numbers."""

    config: str  # file name
    title: str
    baseline_cost: float | None  # average cost of transport, baseline
    proposed_cost: float | None
    baseline_fails: bool  # a gripper detaches under the baseline


CASES: dict[str, Case] = {
    "1.1": Case("case_1_1.yaml", "Earth gravity, 1 kg of cargo", None, 1.31, True),
    "1.2": Case("case_1_2.yaml", "1/6 of Earth gravity, 1 kg of cargo", 1.42, 1.38, False),
    "2": Case("case_2.yaml", "1e-6 of Earth gravity, three pushes", 8.88e4, 6.86e4, False),
}


class Method(NamedTuple):
    """A controller, and what it changes in a case's config."""

    title: str
    changes: dict[str, str]


_PD = {"control.controller": "pd", "control.reading": "virtual_model"}
_NOMINAL, _ACTUAL = {"gait.base_reference": "nominal"}, {"gait.base_reference": "actual"}
BASELINE, BASELINE_ACTUAL = "pd", "pd_actual"
READINGS = ("virtual_model", "measured_pose")
METHODS: dict[str, Method] = {
    BASELINE: Method("pd", {**_PD, **_NOMINAL}),
    # each cycle's base reference starts from where the base has sagged to: perhaps why the paper's baseline fails
    BASELINE_ACTUAL: Method("pd, actual base", {**_PD, **_ACTUAL}),
    "virtual_model": Method(
        "virtual model", {"control.controller": "base_admittance", "control.reading": "virtual_model", **_NOMINAL}
    ),
    "measured_pose": Method(
        "measured pose", {"control.controller": "base_admittance", "control.reading": "measured_pose", **_NOMINAL}
    ),
    "end_effector": Method(
        "end effector",
        {"control.controller": "end_effector_admittance", "control.reading": "virtual_model", **_NOMINAL},
    ),
}


@dataclasses.dataclass(frozen=True)
class Walk:
    """A walk with grippers of the case's holding limit and, where one let go, the same with grippers that never do."""

    trajectory: mc.Trajectory
    unlimited: mc.Trajectory | None = None

    @property
    def whole(self) -> mc.Trajectory:
        """The walk to compare levels with: one that was not cut short by a detachment."""
        return self.trajectory if self.unlimited is None else self.unlimited


class Verdict(NamedTuple):
    """Whether a claim holds, None where nothing can be said; the numbers behind it, and one sentence."""

    holds: bool | None
    measured: dict[str, Any]
    sentence: str


# ------------------------------------------------------------------------------------------------------------
# Claims


def force_oscillation(baseline: mc.Trajectory, proposed: mc.Trajectory, _: Case) -> Verdict:
    """The reaction force oscillates less: the variation of the largest foot force falls."""
    forces = [np.linalg.norm(walk.foot_force, axis=-1).max(1) for walk in (baseline, proposed)]
    varied, peak = [_variation(force) for force in forces], [float(force.max()) for force in forces]
    holds = _falls(*varied)
    return Verdict(
        holds,
        _measured(force_variation=varied, peak_foot_force=peak),
        f"The reaction force {'oscillates less' if holds else 'does not oscillate less'}: "
        f"variation of the largest foot force {_went(varied, 'N')}, its peak {_went(peak, 'N')}.",
    )


def torque_spikes(baseline: mc.Trajectory, proposed: mc.Trajectory, _: Case) -> Verdict:
    """Joint torque spikes are smaller: the peak and the variation over all joints both fall."""
    varied = [_variation(walk.joint_torque) for walk in (baseline, proposed)]
    peak = [float(np.abs(walk.joint_torque).max()) for walk in (baseline, proposed)]
    settled = [_peak_torque_away_from_grip_changes(walk) for walk in (baseline, proposed)]
    falls = _falls(*peak), _falls(*varied)
    words = {
        (True, True): "The joint torques have smaller spikes",
        (False, True): "The joint torques vary less, but their peak does not fall",
        (True, False): "The peak of the joint torques falls, but they vary no less",
        (False, False): "Neither the peak nor the variation of the joint torques falls",
    }
    jump = "" if settled == peak else f"; away from grip changes the peak goes {_went(settled, 'N m')}"
    return Verdict(
        all(falls),
        _measured(peak_joint_torque=peak, torque_variation=varied, peak_away_from_grip_changes=settled),
        f"{words[falls]}: peak {_went(peak, 'N m')}, variation over all joints {_went(varied, 'N m')}{jump}.",
    )


def detachment(baseline: mc.Trajectory, proposed: mc.Trajectory, published: Case) -> Verdict:
    """A gripper detaches under the baseline and none under the proposed controller."""
    lost = [_first_loss(walk) for walk in (baseline, proposed)]
    pull = [_peak_pull(walk) for walk in (baseline, proposed)]
    limit = baseline.scenario.contact.holding_limit
    measured = {
        "detached_at": before_and_after([None if loss is None else loss[0] for loss in lost]),
        "detached_limb": before_and_after([None if loss is None else loss[1] for loss in lost]),
        "peak_pull_force": before_and_after(pull),
        "holding_limit": limit,
    }
    names = [
        f"{who} holds all the way" if loss is None else f"{who} loses {loss[1]} at {loss[0]:.2f} s"
        for who, loss in zip(("the baseline", "the proposed controller"), lost, strict=True)
    ]
    pulls = f"the grippers pull at most {_number(pull[0])} and {_number(pull[1])} N"
    pulls += "" if limit is None else f" of the {limit:g} N that they bear"
    if lost[0] is not None or lost[1] is not None:
        holds = lost[1] is None
        sentence = f"Detachment is {'avoided' if holds else 'not avoided'}: {names[0]}, {names[1]}"
    elif published.baseline_fails:
        holds, sentence = (
            False,
            f"There is no detachment to avoid: both hold all the way, while in the paper the baseline fails; {pulls}",
        )
    else:
        holds, sentence = (
            None,
            f"There is no detachment to avoid: both hold all the way, and the paper reports none; {pulls}",
        )
    return Verdict(holds, measured, sentence + ".")


def margin_fluctuation(baseline: mc.Trajectory, proposed: mc.Trajectory, _: Case) -> Verdict:
    """TSM and GIA margin fluctuate less: the variation of both falls, as far as all grippers hold in both walks."""
    walks = (baseline, proposed)
    rows = min(walk.time.size if (row := _first_loss_row(walk)) is None else row for walk in walks)
    if rows < 2:
        return Verdict(None, {}, "Nothing can be said of the margins: a gripper is lost at once.")
    tsm, gia = ([_variation(getattr(walk, name)[:rows]) for walk in walks] for name in ("tsm", "gia_margin"))
    defined = [(values, unit) for values, unit in ((tsm, "m"), (gia, "m/s^2")) if np.isfinite(values).all()]
    holds = all(_falls(*values) for values, _ in defined) if defined else None
    parts = [
        f"variation of the {name} {_went(values, unit)}" if np.isfinite(values).all() else f"no {name} is defined"
        for name, values, unit in (("TSM", tsm, "m"), ("GIA margin", gia, "m/s^2"))
    ]
    return Verdict(
        holds,
        _measured(gia_margin_variation=gia, tsm_variation=tsm) | {"until": float(baseline.time[rows - 1])},
        f"The margins {'fluctuate less' if holds else 'do not both fluctuate less'}: {', '.join(parts)}.",
    )


def cost_of_transport(baseline: mc.Trajectory, proposed: mc.Trajectory, published: Case) -> Verdict:
    """The cost of transport falls."""
    cost: list[Any] = [mc.metrics(walk)["cost_of_transport"] for walk in (baseline, proposed)]
    paper = [published.baseline_cost, published.proposed_cost]
    stated = f"in the paper {_went(paper, '')}" if None not in paper else ""
    if not stated and published.baseline_fails and published.proposed_cost is not None:
        stated = f"in the paper the baseline fails and the proposed controller costs {_number(published.proposed_cost)}"
    measured = {**_measured(cost_of_transport=cost), "published": before_and_after(paper)}
    if None in cost:
        return Verdict(None, measured, "Nothing can be said of the cost of transport: a walk got nowhere.")
    holds = _falls(*cost)
    sentence = f"The cost of transport {'falls' if holds else 'does not fall'}: {_went(cost, '')}"
    return Verdict(holds, measured, f"{sentence}; {stated}." if stated else f"{sentence}.")


def moves_with_push(baseline: mc.Trajectory, proposed: mc.Trajectory, _: Case) -> Verdict:
    """The base gives way to every push: it moves further along it than under the baseline."""
    shifts = [_push_shifts(walk) for walk in (baseline, proposed)]
    if not shifts[0]:
        return Verdict(None, {}, "Nothing pushes the base in this case.")
    holds = all(p > 0 and _falls(p, b) for b, p in zip(*shifts, strict=True))
    mean = [float(np.mean(values)) for values in shifts]
    listed = [", ".join(f"{1e3 * value:.2f}" for value in values) for values in shifts]
    return Verdict(
        holds,
        _measured(mean_shift=mean) | {"shifts": before_and_after(shifts)},
        f"The base {'moves further with every push' if holds else 'does not move further with every push'}: "
        f"on average over each push {listed[1]} mm along it, {listed[0]} mm under the baseline.",
    )


class Claim(NamedTuple):
    """A claim in words, and what judges it."""

    text: str
    judge: Callable[[mc.Trajectory, mc.Trajectory, Case], Verdict]
    whole: bool = True  # compares levels, so needs walks that no detachment cuts short


CLAIMS: dict[str, Claim] = {
    "force_oscillation": Claim("the reaction force oscillates less", force_oscillation),
    "torque_spikes": Claim("joint torque spikes are smaller", torque_spikes),
    "detachment": Claim("detachment is avoided", detachment, whole=False),
    "margin_fluctuation": Claim("TSM and GIA margin fluctuate less", margin_fluctuation, whole=False),
    "cost_of_transport": Claim("the cost of transport falls", cost_of_transport),
    "moves_with_push": Claim("the base moves with the push", moves_with_push),
}


def judge(name: str, baseline: Walk, proposed: Walk, published: Case) -> Verdict:
    """Return the verdict on one claim; on walks that diverged there is none."""
    claim = CLAIMS[name]
    before, after = (walk.whole if claim.whole else walk.trajectory for walk in (baseline, proposed))
    for who, walk in (("baseline", before), ("proposed controller", after)):
        if not (np.isfinite(walk.base_position).all() and np.isfinite(walk.foot_force).all()):
            return Verdict(None, {}, f"Nothing can be said: the walk of the {who} diverges.")
    verdict = claim.judge(before, after, published)
    if claim.whole and (baseline.unlimited or proposed.unlimited):
        return verdict._replace(sentence=f"{verdict.sentence[:-1]} (grippers that never let go).")
    return verdict


def judge_all(walks: Mapping[str, Walk], published: Case) -> dict[str, dict[str, Verdict]]:
    """Return the verdicts on every claim by reading of Eq. 3.

    Where the paper's baseline fails, `detachment_actual` judges the baseline whose reference follows the actual base.
    """
    verdicts: dict[str, dict[str, Verdict]] = {reading: {} for reading in READINGS}
    for reading, found in verdicts.items():
        for name in CLAIMS:
            found[name] = judge(name, walks[BASELINE], walks[reading], published)
            if name == "detachment" and published.baseline_fails:
                found["detachment_actual"] = judge(name, walks[BASELINE_ACTUAL], walks[reading], published)
    return verdicts


# ------------------------------------------------------------------------------------------------------------
# Measures


def _variation(values: np.ndarray) -> float:
    """Return the sum of all changes from step to step, over everything that changes."""
    return float(np.abs(np.diff(values, axis=0)).sum())


def _first_loss_row(walk: mc.Trajectory) -> int | None:
    lost = walk.torn_off.any(1)
    return int(lost.argmax()) if lost.any() else None


def _first_loss(walk: mc.Trajectory) -> tuple[float, str] | None:
    """Return when (s) and which gripper was torn off first."""
    row = _first_loss_row(walk)
    return None if row is None else (float(walk.time[row]), walk.limbs[int(walk.torn_off[row].argmax())])


def _peak_pull(walk: mc.Trajectory) -> float:
    """Return the largest force of a gripper that the ground pulls down, N."""
    pulling = walk.support & (walk.foot_force[..., 2] < 0)
    return float(np.where(pulling, np.linalg.norm(walk.foot_force, axis=-1), 0.0).max())


def _peak_torque_away_from_grip_changes(walk: mc.Trajectory) -> float:
    """Return the peak joint torque, N m, without the moments in which a gripper has just opened or shut.

    A foot that lifts off is at once commanded along its planned swing, wherever it was, and one whose gripper shuts to
    where it stands: a jump that dies away within a few steps.
    """
    kept = np.ones(walk.time.size, bool)
    for row in np.flatnonzero((walk.support[1:] != walk.support[:-1]).any(1)) + 1:
        kept[row : row + round(SETTLED / walk.scenario.time_step)] = False
    return float(np.abs(walk.joint_torque[kept]).max(initial=0.0))


def _push_shifts(walk: mc.Trajectory) -> list[float]:
    """Return for each push how far the base went along it, m: the mean over the push, beyond where it began.

    What the base does off its reference counts, not the walk itself.
    """
    force = walk.push[:, :3]
    changed = np.flatnonzero((force[1:] != force[:-1]).any(1)) + 1
    shifts = []
    for rows in np.split(np.arange(len(force)), changed):
        strength = np.linalg.norm(force[rows[0]])
        if strength > 0:
            offset = (walk.base_position[rows] - walk.base_reference[rows]) @ (force[rows[0]] / strength)
            shifts.append(float(offset.mean() - offset[0]))
    return shifts


def _falls(before: float, after: float) -> bool:
    return after < (1 - UNCHANGED) * before


# ------------------------------------------------------------------------------------------------------------
# Words


def before_and_after(values: Sequence[Any]) -> dict[str, Any]:
    """Return two values by whose they are: the baseline's, and the proposed controller's."""
    return dict(zip(("baseline", "proposed"), values, strict=True))


def _measured(**pairs: Sequence[float | None]) -> dict[str, Any]:
    """Return pairs by name, and as `change` the relative change of the first."""
    return {name: before_and_after(values) for name, values in pairs.items()} | {
        "change": _change(next(iter(pairs.values())))
    }


def _change(values: Sequence[float | None]) -> float | None:
    before, after = values
    if before is None or after is None or not before or not math.isfinite(after / before):
        return None
    return after / before - 1


def _number(value: float) -> str:
    return f"{value:.4g}"


def _went(values: Sequence[Any], unit: str) -> str:
    """Return "from a to b unit (+c %)"."""
    change = _change(values)
    percent = "" if change is None else f" ({100 * change:+.1f} %)"
    return f"from {_number(values[0])} to {_number(values[1])}{' ' * bool(unit)}{unit}{percent}"
