"""Gains on the walks of an ensemble that no search has seen, row by row, so that they can be kept and shared out."""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.disturbances.on_base import Push
from mjx_climb.execution.batch_axes import own_axes
from mjx_climb.execution.contents import identity
from mjx_climb.files import dataset
from mjx_climb.inputs.from_scenario import gains as gains_of
from mjx_climb.inputs.gait_values import GAIT, gait_of
from mjx_climb.inputs.resolve import AnyGains, resolve_in
from mjx_climb.parameter_types import path_of_gain
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import FAILURES, SENSORS
from tuning.gains import gains_file
from tuning.gains.gains_file import Whole, by_name
from tuning.methods.parts import identity_of
from tuning.problem import ensemble as ensembles
from tuning.problem.ensemble import Ensemble, Use
from tuning.problem.ensemble import fresh as fresh
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import BINDING, Objective, Term, in_words, lost, violation
from tuning.problem.readings import reads_forces
from tuning.problem.search import LOST, Judge
from tuning.results.config_file import write_config
from tuning.results.judged import Judged
from tuning.searches.shards import Counted, Kept, Rows, walk_shard
from tuning.searches.sweep import default_batch_size

MEMBERS = Judge().members
WORST_SHARE = 0.05  # of the members of the unseen draw: "the worst 5 %"
PD = "pd"
LOST_SENSORS = "lost_sensors"  # of a dataset: in words, which laws did without a force sensor
READING = "reads_forces"  # attribute of walks: names of the gains whose law reads forces


def evaluate(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains | Whole],
    ensemble: Ensemble,
    *,
    members: int = MEMBERS,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    out: str | os.PathLike[str] | None = None,
    progress: Counted | None = None,
) -> Judged:
    """Simulate several gains with members that no search over the ensemble has seen, beside the scenario's own and pd.

    Nothing is torn off, so that every walk counts to its end; one whose grip uses more than its limit, or
    that diverges, has failed, see `summary`. `tuning.write(tuning.evaluate(scenario, gains, ensemble), folder)` is
    `mjx-climb evaluate`.

    Arguments:
        scenario: robot, gait and ground, under an admittance law.
        gains: by name; with laws of their own as `tuning.gains.gains_file.whole(file, scenario)` gives them.
        ensemble: of the walks; drawn again with another seed.
        members: walks of each set of gains.
        law: whose gains they are, where it is not the scenario's.
        metrics, engine, out: as of `tuning.sweep`.
        progress: called with the number of members that have walked and the number in all.

    Raises:
        ConfigError: an ensemble that the scenario does not allow.
        OutputError: `out` cannot be written, or holds unfinished walks of something else.
    """
    problem = Problem(scenario, law=law, metrics=mc.MetricTable(metrics), engine=engine)
    draw = draw_of(problem, gains, ensemble, members)
    return draw.result(Rows(draw, out).walk(progress))


def evaluate_shard(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains | Whole],
    ensemble: Ensemble,
    shard: tuple[int, int],
    *,
    out: str | os.PathLike[str],
    members: int = MEMBERS,
    progress: Counted | None = None,
    **walks: Any,
) -> Path:
    """Simulate a shard of `evaluate`, with the same arguments, for `merge`; `mjx-climb evaluate --shard 3/16`.

    `shard`, `out`, `progress`, result and errors are as of `sweep_shard`.
    """
    walks["metrics"] = mc.MetricTable(walks.get("metrics", mc.METRICS))
    return walk_shard(draw_of(Problem(scenario, **walks), gains, ensemble, members), shard, out, progress)


@dataclasses.dataclass(frozen=True)
class Draw:
    """Gains that walk through an ensemble: a `tuning.searches.shards.Work`. A row is one member, with all gains."""

    problem: Problem  # with the ensemble that walks, and its parameters
    gains: Mapping[str, AnyGains | Whole]  # by name
    pd: Mapping[str, AnyGains]  # joint gains of pd, by name; the scenario's walk as "pd"
    ensemble: Ensemble | None  # as its user gave it
    rows: int  # members
    size: int  # members that walk at a time

    @property
    def _whole(self) -> dict[str, Whole]:
        """The gains by name with their law."""
        own, scenario = self.problem.law, self.problem.scenario
        each = {name: each if isinstance(each, Whole) else Whole(own, each) for name, each in self.gains.items()}
        return {name: Whole(law, gains_file.in_whole(scenario, law, gains)) for name, (law, gains) in each.items()}

    def walk(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the metrics of some members, (rows, gains)."""
        scenario, drawn = self.problem.scenario, self.problem.parameters
        parameters = jax.tree.map(lambda value, own: value[rows] if value.ndim > own else value, drawn, own_axes(drawn))
        joint = {"kp": scenario.control.kp, "kd": scenario.control.kd}
        pd, found = under_pd(scenario), []
        walkers: list[tuple[mc.Scenario, mc.Law | None, AnyGains]]
        walkers = [(scenario, *own) for own in self._whole.values()]
        walkers += [(pd, None, gains) for gains in (*self.pd.values(), joint)]
        for place, whose, gains in walkers:
            one = resolve_in(place, whose or law_of(place), gains, None, np.float64)
            batch = {name: getattr(one.law, name)[None] for name in one.law.GAINS}  # of one
            batch |= {name: one.parameters.at(path_of_gain(name))[None] for name in joint}
            if gait_of(by_name(gains)):
                batch |= {key: one.own.at(key)[None] for key in GAIT}
            table = self.problem.metrics + SENSORS
            how = {**self.problem.walks, "law": whose, "metrics": table, "dtype": np.float32}
            how |= {"smooth": True, "unsteady": True}
            found.append(mc.rollout_metrics(place, batch, parameters, **how))
        return {name: np.concatenate([each[name] for each in found], axis=1) for name in table.names}

    def name(self, row: int) -> str:
        return f"member {row}"

    def dataset(self, arrays: Mapping[str, np.ndarray]) -> xr.Dataset:
        """Return the results of all rows, labelled, with the draw."""
        problem, scenario, drawn = self.problem, self.problem.scenario, self.problem.parameters
        ensemble, members = problem.ensemble, self.rows
        assert drawn is not None and ensemble is not None
        data: dict[str, Any] = {}
        for metric in problem.metrics:
            data[metric.name] = (("gains", "member"), arrays[metric.name].T, dataset.metric_attributes(metric))
        units = drawn.units
        for path, each in _of_members(drawn, members).items():
            unit, text = units.get(path, ("N", "largest push"))
            data[path] = ("member", each, {"units": unit, "long_name": text})
        each_lost = lost(arrays).T.astype(bool)
        data[LOST] = (("gains", "member"), each_lost, {"long_name": "walk loses a gripper or diverges"})
        attrs: dict[str, Any] = {"title": "gains on the walks of an ensemble", **dataset.provenance(scenario)}
        attrs["ensemble"] = ensemble.to_yaml()
        names, limbs = [*self.gains, *self.pd, PD], scenario.limbs
        sensors = {name: _lost(arrays, number, limbs) for number, name in enumerate(names)}
        laws = ((name, dataclasses.replace(problem, law=law)) for name, (law, _) in self._whole.items())
        attrs[READING] = ", ".join(name for name, own in laws if reads_forces(own))
        attrs[LOST_SENSORS] = "; ".join(f"{name} {text}" for name, text in sensors.items() if text)
        return xr.Dataset(data, {"gains": names, "member": np.arange(members)}, attrs)

    def result(self, arrays: Mapping[str, np.ndarray]) -> Judged:
        return Judged(self.dataset(arrays), self.problem, ensemble=self.ensemble)

    def identity(self) -> dict[str, Any]:
        gains = {
            name: {key: np.asarray(value, float).tolist() for key, value in by_name(own).items()}
            | ({} if law is self.problem.law else {gains_file.LAW: identity(law, name)})
            for name, (law, own) in self._whole.items()
        }
        return {"kind": Judged.KIND, **identity_of(self.problem), "gains": gains, "batch_size": self.size}

    def write_asked(self, folder: Path) -> None:
        """Write scenario, law, ensemble and gains for `read_asked`."""
        assert self.ensemble is not None
        write_config(self.problem.scenario, folder, self.problem.law, self.problem.metrics)
        dataset.write_text_atomically(folder / "ensemble.yaml", self.ensemble.to_yaml())
        for number, (law, own) in enumerate(self._whole.values()):
            gains_file.save(own, folder / f"gains-{number}.yaml", "evaluated in this folder", law)


def read_asked(kept: Kept, scenario: mc.Scenario, law: mc.Law | None, metrics: mc.MetricTable) -> Draw:
    """Return the walks that a shard is of, from the files of `Draw.write_asked` in its folder."""
    names = enumerate(kept.identity["gains"])
    gains = {name: gains_file.whole(kept.folder / f"gains-{number}.yaml", scenario, law) for number, name in names}
    ensemble = Ensemble.load(kept.folder / "ensemble.yaml")
    problem = Problem(scenario, law=law, metrics=metrics, engine=kept.identity["engine"])
    return through(problem, gains, fresh(ensemble, Use.EVALUATION), asked=ensemble)


def draw_of(
    problem: Problem, gains: Mapping[str, AnyGains | Whole], ensemble: Ensemble, members: int = MEMBERS
) -> Draw:
    """Return the work of `judge`, whose arguments and errors these are."""
    asked = ensemble.model_copy(update={"members": members})
    walked = {**gains, "config": problem.law or gains_of(problem.scenario)}
    return through(problem, walked, fresh(asked, Use.EVALUATION), asked=asked)


def through(
    problem: Problem,
    gains: Mapping[str, AnyGains | Whole],
    ensemble: Ensemble,
    pd: Mapping[str, AnyGains] = MappingProxyType({}),
    asked: Ensemble | None = None,
) -> Draw:
    """Return the walks of gains by name, of further joint gains of pd, and of pd through an ensemble.

    Raises:
        ConfigError: an ensemble that the scenario does not allow.
    """
    drawn, members = ensembles.draw(problem.scenario, ensemble), ensemble.members
    walked = dataclasses.replace(problem, parameters=drawn, members=members, ensemble=ensemble)
    return Draw(walked, gains, pd, asked, members, default_batch_size(members, problem.scenario.steps))


def _of_members(drawn: mc.Parameters, members: int) -> dict[str, np.ndarray]:
    """Return the values that differ among members, (members,) each by its path, and the largest push of each, N."""
    found, paths = {}, drawn.paths
    for path, value in drawn.values.items():
        if paths[path].shape == () and np.ndim(value) and not path.startswith("disturbance.pushes."):
            found[path] = np.broadcast_to(np.reshape(value, -1), members)
    found["gravity"] = np.broadcast_to(np.linalg.norm(drawn.gravity, axis=-1).reshape(-1), members)
    forces = [each.force for each in drawn.disturbances if isinstance(each, Push)]
    pushes = [np.broadcast_to(np.linalg.norm(force, axis=-1).reshape(-1), members) for force in forces]
    found["largest_push"] = np.max([np.zeros(members), *pushes], axis=0)
    return found


def _lost(arrays: Mapping[str, np.ndarray], number: int, limbs: tuple[str, ...]) -> str:
    """Return in words in how many walks of the gains of this number the law did without a force sensor, "" for none."""
    at, limb = (arrays[name][:, number] for name in SENSORS.names)
    there = limb >= 0
    if not there.any():
        return ""
    earliest = {limbs[one]: float(at[there & (limb == one)].min()) for one in np.unique(limb[there])}
    return f"{without_sensors(earliest)} in {there.sum()} of {len(limb)} walks"


def without_sensors(lost: Mapping[str, float]) -> str:
    """Return in words which force sensors a law did without, and from when on, s, by limb, "" for none."""
    each = ", ".join(f"{limb} from {at:.2f} s" for limb, at in lost.items())
    return f"ran without the force sensor of {each}" if each else ""


def plain(summed: xr.Dataset, metrics: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the share of walks that failed, mean and worst of some metrics by the names of the gains."""
    found: dict[str, dict[str, Any]] = {}
    for name in summed["gains"].values.tolist():
        own = summed.sel(gains=name)
        found[name] = {"failed": float(own["failed"])}
        for statistic in ("mean", "worst"):
            found[name][statistic] = {metric: float(own[metric].sel(statistic=statistic)) for metric in metrics}
    return found


def failed_in_words(summed: xr.Dataset) -> str:
    """Return "would lose a gripper, or diverge: mine 0%, pd 3%"."""
    names = summed["gains"].values.tolist()
    lost = ", ".join(f"{name} {share:.0%}" for name, share in zip(names, summed["failed"].values, strict=True))
    text = f"would lose a gripper, or diverge: {lost}"
    if "missed" not in summed or not summed["missed"].any():
        return text
    missed = zip(names, summed["missed"].values, strict=True)
    return f"{text}; missed grips of a walk: " + ", ".join(f"{name} {number:.2g}" for name, number in missed)


def lost_in_words(walks: xr.Dataset) -> list[str]:
    """Return a warning that laws did without force sensors in some walks, none where none did."""
    text = walks.attrs.get(LOST_SENSORS)
    return [f"warning: {text}"] if text else []


def held(walks: xr.Dataset) -> xr.Dataset:
    """Return the walks that gains are compared by: the one rule for walks that diverge.

    Gains that diverge in more than half of the walks (of one of their searches, where there are several) are left out.
    So are members where any of the others diverges: all are compared on the same walks.
    """
    diverged = walks["diverged"].astype(bool)
    others = [name for name in diverged.dims if name not in ("gains", "member")]
    sound = (diverged.mean("member") <= 0.5).all(others)
    kept = walks.isel(gains=sound.values)
    return kept.isel(member=~kept["diverged"].astype(bool).any([*others, "gains"]).values)


def summary(walks: xr.Dataset, share: float = WORST_SHARE) -> xr.Dataset:
    """Return mean and worst of every metric, dimensions (`statistic`, `gains`), and the share of walks that failed.

    Both are of the walks that `held` keeps, NaN for gains that it leaves out; the worst is the mean over the worst
    `share` of them, for each metric by itself. `failed` is the share of all members.

    Raises:
        ConfigError: there are none.
    """
    kept = held(walks)
    if not kept["diverged"].size:
        raise ConfigError("", "ensemble", "a member of the draw in which nothing diverges", "none")
    data: dict[str, Any] = {}
    for name in [str(n) for n, v in walks.data_vars.items() if "larger_is_better" in v.attrs and n not in FAILURES]:
        values = kept[name].transpose("member", "gains").values.astype(float)
        worst = ensembles.worst_mean(values, share, larger_is_better=dataset.larger_is_better(walks[name]))
        data[name] = (("statistic", "gains"), np.stack([values.mean(0), worst]), walks[name].attrs)
    both = xr.Dataset(data, {"statistic": ["mean", "worst"], "gains": kept["gains"].values})
    about = {"units": "1", "long_name": "share of walks that lose a gripper or diverge"}
    attrs = {**walks.attrs, "worst_share": share, "members_compared": kept.sizes["member"]}
    lost = xr.DataArray(failed(walks).mean("member").values, {"gains": walks["gains"].values}, ("gains",), attrs=about)
    both = both.reindex(gains=walks["gains"].values).assign(failed=lost).assign_attrs(attrs)
    if "missed_grips" in walks:
        about = {"units": "1", "long_name": "missed grips of a walk"}
        both = both.assign(missed=("gains", walks["missed_grips"].astype(float).mean("member").values, about))
    return both


def failed(walks: xr.Dataset) -> xr.DataArray:
    """Return which walks lose a gripper, diverge or stand for want of a grip, dimensions as of the walks."""
    found: xr.DataArray = lost(walks).astype(bool)
    return found


def broken(walks: xr.Dataset, goal: Objective) -> xr.DataArray:
    """Return the share of walks that break each limit of a search, or diverge, (`limit` in words, `gains`)."""
    shares, words = [], [in_words(limit) for limit in goal.limits]
    for limit in goal.limits:
        kept = violation(limit, walks[limit.metric].values.astype(float)) <= 0
        if goal.weighs_lost:
            kept |= failed(walks).values
        shares.append((~kept | walks["diverged"].values.astype(bool)).mean(1))
    about = {"units": "1", "long_name": "share of walks that break the limit"}
    values = np.reshape(shares, (len(words), walks.sizes["gains"]))
    return xr.DataArray(values, {"limit": words, "gains": walks["gains"].values}, ("limit", "gains"), attrs=about)


def scores(walks: xr.Dataset, goal: Objective) -> xr.DataArray:
    """Return the objective over the walks of a draw, (`gains`): 1 for pd on the same walks."""
    rows = {str(name): walks[name].values for name in walks.data_vars if walks[name].ndim == 2}
    fresh = dataclasses.replace(goal, terms=terms_on(walks, goal))
    value = np.asarray(fresh.score({name: jnp.asarray(values.T) for name, values in rows.items()}).value)
    return xr.DataArray(value, {"gains": walks["gains"].values}, attrs={"units": "1", "long_name": "objective"})


def terms_on(walks: xr.Dataset, goal: Objective) -> tuple[Term, ...]:
    """Return the terms of an objective relative to pd on the walks of a draw."""
    terms, share = [], goal.worst.share if goal.worst is not None else 1.0
    for term in goal.terms:
        pd = walks[term.metric].sel(gains=PD).values
        mean, worst = float(pd.mean()), float(ensembles.worst_mean(pd, share, larger_is_better=term.larger_is_better))
        terms.append(term._replace(baseline=mean, smooth_baseline=mean, worst=worst, smooth_worst=worst))
    return tuple(terms)


def binding(seen: xr.Dataset, goal: Objective, name: str) -> list[str]:
    """Return in words which limits hold gains where they are: kept in every member that was `seen`, hardly in one."""
    rows = {str(key): values.values.astype(float) for key, values in seen.sel(gains=name).data_vars.items()}
    if rows["diverged"].any():
        return []
    worst = [float(np.max(violation(limit, rows[limit.metric]))) for limit in goal.limits]
    held = [in_words(own) for own, most in zip(goal.limits, worst, strict=True) if -BINDING * own.margin <= most <= 0]
    if goal.margin is None or goal.worst is None:
        return held
    for term in goal.terms:
        ratios = goal.ratios(jnp.asarray(rows[term.metric]), term)
        for ratio, words in zip(ratios, ("mean", f"mean of the worst {goal.worst.share:.0%}"), strict=True):
            if 1 - BINDING * goal.margin <= float(ratio) <= 1:
                held.append(f"{words} of {mc.METRICS.in_words(term.metric)} no worse than pd's")
    return held
