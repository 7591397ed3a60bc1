"""The paper's claims on its three cases, and whether walks of ours bear them out.

M. Imai, K. Uno, K. Yoshida, "Admittance control-based floating base reaction mitigation for limbed climbing robots".

A claim is a function of two walks, the baseline's and the proposed controller's, and of the case's published numbers.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

import mjx_climb as mc

UNCHANGED = 0.005  # a smaller relative change is none
SETTLED = 0.02  # s after a grip change: its jump of the joints' targets is over


class Case(NamedTuple):
    """A case of the paper and its published numbers."""

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
    """A controller, by its changes of a case's config."""

    title: str
    controller: str
    reading: str = "virtual_model"
    reference: str = "nominal"

    @property
    def changes(self) -> dict[str, str]:
        """The changed keys."""
        return dict(zip(("control.controller", "control.reading", "gait.base_reference"), self[1:], strict=True))


BASELINE, BASELINE_ACTUAL = "pd", "pd_actual"
READINGS = ("virtual_model", "measured_pose")
METHODS: dict[str, Method] = {
    BASELINE: Method("pd", "pd"),
    # each cycle's base reference starts from where the base has sagged to: perhaps why the paper's baseline fails
    BASELINE_ACTUAL: Method("pd, actual base", "pd", reference="actual"),
    "virtual_model": Method("virtual model", "base_admittance"),
    "measured_pose": Method("measured pose", "base_admittance", "measured_pose"),
    "end_effector": Method("end effector", "end_effector_admittance"),
}


class Walk(NamedTuple):
    """A walk with grippers of the case's holding limit and, where one let go, the same with grippers that never do."""

    trajectory: mc.Trajectory
    unlimited: mc.Trajectory | None = None


class Verdict(NamedTuple):
    """Whether a claim holds, None where nothing can be said; the numbers behind it, and one sentence."""

    holds: bool | None
    measured: dict[str, Any]
    sentence: str


class Pair(NamedTuple):
    """A quantity of both walks, None where a walk has none."""

    baseline: Any
    proposed: Any

    @classmethod
    def of(cls, measure: Callable[[Any], Any], walks: "Pair") -> "Pair":
        """Measure both walks."""
        return cls(measure(walks.baseline), measure(walks.proposed))

    @property
    def change(self) -> float | None:
        """The relative change from the baseline, None where there is none."""
        before, after = self
        defined = before and after is not None and math.isfinite(after / before)
        return float(after / before - 1) if defined else None

    @property
    def falls(self) -> bool:
        """Whether the proposed controller has less, by more than `UNCHANGED`."""
        return bool(self.proposed < (1 - UNCHANGED) * self.baseline)

    def in_words(self, unit: str = "") -> str:
        """Return "from a to b unit (+c %)"."""
        percent = "" if self.change is None else f" ({100 * self.change:+.1f} %)"
        return f"from {self.baseline:.4g} to {self.proposed:.4g}{' ' * bool(unit)}{unit}{percent}"


def _measured(**pairs: Pair) -> dict[str, Any]:
    """Return pairs by name, and as `change` the relative change of the first."""
    return {name: pair._asdict() for name, pair in pairs.items()} | {"change": next(iter(pairs.values())).change}


def force_oscillation(walks: Pair, _: Case) -> Verdict:
    """The reaction force oscillates less: the variation of the largest foot force falls."""
    force = Pair.of(lambda walk: np.linalg.norm(walk.foot_force, axis=-1).max(1), walks)
    varied, peak = Pair.of(_variation, force), Pair.of(lambda values: float(values.max()), force)
    return Verdict(
        varied.falls,
        _measured(force_variation=varied, peak_foot_force=peak),
        f"The reaction force {'oscillates less' if varied.falls else 'does not oscillate less'}: "
        f"variation of the largest foot force {varied.in_words('N')}, its peak {peak.in_words('N')}.",
    )


def torque_spikes(walks: Pair, _: Case) -> Verdict:
    """Joint torque spikes are smaller: the peak and the variation over all joints both fall."""
    varied = Pair.of(lambda walk: _variation(walk.joint_torque), walks)
    peak = Pair.of(lambda walk: float(np.abs(walk.joint_torque).max()), walks)
    settled = Pair.of(_peak_torque_away_from_grip_changes, walks)
    words = {
        (True, True): "The joint torques have smaller spikes",
        (False, True): "The joint torques vary less, but their peak does not fall",
        (True, False): "The peak of the joint torques falls, but they vary no less",
        (False, False): "Neither the peak nor the variation of the joint torques falls",
    }
    away = "" if settled == peak else f"; away from grip changes the peak goes {settled.in_words('N m')}"
    return Verdict(
        peak.falls and varied.falls,
        _measured(peak_joint_torque=peak, torque_variation=varied, peak_away_from_grip_changes=settled),
        f"{words[peak.falls, varied.falls]}: peak {peak.in_words('N m')}, "
        f"variation over all joints {varied.in_words('N m')}{away}.",
    )


def _peak_torque_away_from_grip_changes(walk: mc.Trajectory) -> float:
    """Return the peak joint torque, N m, without the moments after a gripper has opened or shut.

    A foot that lifts off is at once commanded along its planned swing, wherever it was, and one whose gripper shuts to
    where it stands: a jump that dies away within a few steps.
    """
    kept = np.ones(walk.time.size, bool)
    for row in _changes(walk.support):
        kept[row : row + round(SETTLED / walk.scenario.time_step)] = False
    return float(np.abs(walk.joint_torque[kept]).max(initial=0.0))


def detachment(walks: Pair, published: Case) -> Verdict:
    """A gripper detaches under the baseline and none under the proposed controller."""
    lost, limit = Pair.of(_first_loss, walks), walks.baseline.scenario.contact.holding_limit

    def peak_pull(walk: mc.Trajectory) -> float:  # of a gripper that the ground pulls down
        pulling = walk.support & (walk.foot_force[..., 2] < 0)
        return float(np.where(pulling, np.linalg.norm(walk.foot_force, axis=-1), 0.0).max())

    pull = Pair.of(peak_pull, walks)
    measured = {
        "detached_at": Pair.of(lambda loss: loss and loss[1], lost)._asdict(),
        "detached_limb": Pair.of(lambda loss: loss and loss[2], lost)._asdict(),
        "peak_pull_force": pull._asdict(),
        "holding_limit": limit,
    }
    if any(lost):
        baseline, proposed = ("holds all the way" if loss is None else f"loses {loss[2]} at {loss[1]:.2f} s"
                              for loss in lost)  # fmt: skip
        avoided = "avoided" if lost.proposed is None else "not avoided"
        words = f"Detachment is {avoided}: the baseline {baseline}, the proposed controller {proposed}."
        return Verdict(lost.proposed is None, measured, words)
    paper = "while in the paper the baseline fails" if published.baseline_fails else "and the paper reports none"
    bear = "" if limit is None else f" of the {limit:g} N that they bear"
    return Verdict(
        False if published.baseline_fails else None,
        measured,
        f"There is no detachment to avoid: both hold all the way, {paper}; the grippers pull at most "
        f"{pull.baseline:.4g} and {pull.proposed:.4g} N{bear}.",
    )


def _first_loss(walk: mc.Trajectory) -> tuple[int, float, str] | None:
    """Return the row, the time (s) and the name of the gripper that was torn off first."""
    row = int(walk.torn_off.any(1).argmax())
    lost = walk.torn_off[row]
    return (row, float(walk.time[row]), walk.limbs[int(lost.argmax())]) if lost.any() else None


def margin_fluctuation(walks: Pair, _: Case) -> Verdict:
    """TSM and GIA margin fluctuate less: the variation of both falls, as far as all grippers hold in both walks."""
    rows = min(loss[0] if (loss := _first_loss(walk)) else walk.time.size for walk in walks)
    if rows < 2:
        return Verdict(None, {}, "Nothing can be said of the margins: a gripper is lost at once.")
    tsm = Pair.of(lambda walk: _variation(walk.tsm[:rows]), walks)
    gia = Pair.of(lambda walk: _variation(walk.gia_margin[:rows]), walks)
    falls, parts = [], []
    for name, pair, unit in (("TSM", tsm, "m"), ("GIA margin", gia, "m/s^2")):
        if np.isfinite(pair).all():
            falls.append(pair.falls)
            parts.append(f"variation of the {name} {pair.in_words(unit)}")
        else:
            parts.append(f"no {name} is defined")
    holds = all(falls) if falls else None
    return Verdict(
        holds,
        _measured(gia_margin_variation=gia, tsm_variation=tsm) | {"until": float(walks.baseline.time[rows - 1])},
        f"The margins {'fluctuate less' if holds else 'do not both fluctuate less'}: {', '.join(parts)}.",
    )


def cost_of_transport(walks: Pair, published: Case) -> Verdict:
    """The cost of transport falls."""
    cost = Pair.of(lambda walk: mc.metrics(walk)["cost_of_transport"], walks)
    paper, stated = Pair(published.baseline_cost, published.proposed_cost), ""
    if None not in paper:
        stated = f"; in the paper {paper.in_words()}"
    elif published.baseline_fails and paper.proposed is not None:
        stated = f"; in the paper the baseline fails and the proposed controller costs {paper.proposed:.4g}"
    measured = {**_measured(cost_of_transport=cost), "published": paper._asdict()}
    if None in cost:
        return Verdict(None, measured, "Nothing can be said of the cost of transport: a walk got nowhere.")
    words = f"The cost of transport {'falls' if cost.falls else 'does not fall'}: {cost.in_words()}{stated}."
    return Verdict(cost.falls, measured, words)


def moves_with_push(walks: Pair, _: Case) -> Verdict:
    """The base gives way to every push: it moves further along it than under the baseline."""
    shifts = Pair.of(_push_shifts, walks)
    if not shifts.baseline:
        return Verdict(None, {}, "Nothing pushes the base in this case.")
    holds = all(ours > 0 and Pair(ours, theirs).falls for theirs, ours in zip(*shifts, strict=True))
    theirs, ours = (", ".join(f"{1e3 * value:.2f}" for value in values) for values in shifts)
    return Verdict(
        holds,
        _measured(mean_shift=Pair.of(lambda values: float(np.mean(values)), shifts)) | {"shifts": shifts._asdict()},
        f"The base {'moves further with every push' if holds else 'does not move further with every push'}: "
        f"on average over each push {ours} mm along it, {theirs} mm under the baseline.",
    )


def _push_shifts(walk: mc.Trajectory) -> list[float]:
    """Return for each push how far the base went along it, m: the mean over the push, beyond where it began.

    The base's offset from its reference counts, not the walk itself.
    """
    force, shifts = walk.push[:, :3], []
    for rows in np.split(np.arange(len(force)), _changes(force)):
        strength = np.linalg.norm(force[rows[0]])
        if strength > 0:
            offset = (walk.base_position[rows] - walk.base_reference[rows]) @ (force[rows[0]] / strength)
            shifts.append(float(offset.mean() - offset[0]))
    return shifts


def _variation(values: np.ndarray) -> float:
    """Return the sum of all changes from step to step, over everything that changes."""
    return float(np.abs(np.diff(values, axis=0)).sum())


def _changes(values: np.ndarray) -> np.ndarray:
    """Return the rows of values (T, n) that differ from the ones before."""
    return np.flatnonzero((values[1:] != values[:-1]).any(1)) + 1


class Claim(NamedTuple):
    """A claim in words, and the function that judges it."""

    text: str
    judge: Callable[[Pair, Case], Verdict]
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
    walks = Pair(*((claim.whole and walk.unlimited) or walk.trajectory for walk in (baseline, proposed)))
    for who, walk in zip(("baseline", "proposed controller"), walks, strict=True):
        if not (np.isfinite(walk.base_position).all() and np.isfinite(walk.foot_force).all()):
            return Verdict(None, {}, f"Nothing can be said: the walk of the {who} diverges.")
    verdict = claim.judge(walks, published)
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
