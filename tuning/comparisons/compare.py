"""Laws side by side: each tuned alike, judged on the same unseen walks, beside pd retuned: `tuning.compare`."""

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.control import PD, PlannedTransfer, law_of
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from tuning.background import Stage, silent
from tuning.comparisons import judge as judging
from tuning.gains.own_section import load_law, without
from tuning.methods import Method, grid, method_of, parts
from tuning.methods.rounds import counted
from tuning.problem import spaces
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.readings import reads_forces
from tuning.problem.search import OWN_METHOD, Search
from tuning.problem.variations import Factor, changed, paths_of, scalable
from tuning.results.judged import Comparison
from tuning.results.tuned import Tuned
from tuning.searches import tune
from tuning.searches.retuned_pd import NAME
from tuning.searches.shards import Rows

FEW, MANY = (16, 60), (256, 100)  # points a round, and rounds at most; where a GPU's kernel walks them side by side
PATIENCE = 10  # rounds of so many points without a better one, after which a search has converged
SEEDS, SEEDS_OF_MANY = 3, 8  # searches of each law; where a GPU's kernel walks
CONTROLLERS = ("base_admittance", "end_effector_admittance")
# halves of hardware that retuned pd walks with besides: words of `tuning.problem.variations.WORDS`
HARDWARE = {"half the delay": "delay", "half the friction": "friction", "twice the rate": "period"}
_KEYS = ("also", "bounds", "pins", "frozen")  # settings that name gains


Place = tuple[mc.Scenario, mc.Law | None]  # scenario and law; None: the scenario's
PLANNED = PlannedTransfer.__name__  # rival of laws that read forces, beside pd
Laws = Iterable[str | mc.Law] | Mapping[str, str | mc.Law]


class Contestant(NamedTuple):
    """A law, and the settings that it is tuned by: those of all, without the gains that it does not have."""

    scenario: mc.Scenario
    law: mc.Law | None  # the scenario's where None
    search: Search
    space: spaces.Space


def compare(
    scenario: mc.Scenario,
    laws: Laws,
    ensemble: Ensemble,
    search: Search | None = None,
    *,
    members: int = judging.MEMBERS,
    seeds: int | None = None,
    out: str | os.PathLike[str] | None = None,
    stage: Stage = silent,
    method: tune.OwnMethod | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    **settings: Any,
) -> Comparison:
    """Tune several laws from several seeds until they converge, and judge them on the same unseen walks.

    Each search ends when `PATIENCE` rounds of its points have found nothing better by a thousandth, however many gains
    it has, or when its rounds are spent. All that a search finds is judged: the intervals are of a law that is
    searched once more. pd with kp and kd retuned is always among them, and `PlannedTransfer`, which hands loads over
    without a force sensor, where a law reads forces and the method is not grid: the walks of one law more. All search
    kp and kd too; a gain that `also`, `bounds`, `pins` or `frozen` name is searched, bounded, pinned or frozen where a
    law has it.
    `tuning.write(tuning.compare(scenario, laws, ensemble, out="results/mine"), "results/mine")` is
    `mjx-climb tune --law --law`.

    Arguments:
        scenario: robot, gait and ground.
        laws: instances, or names: `base_admittance`, `end_effector_admittance`, or a name as of `--law`; a mapping
            gives them other names than their own.
        ensemble: of the walks; drawn again with another seed to judge.
        search: the settings; `settings` are keys of `tuning.problem.search.Search` in place of it or to change it. The
            method is cmaes, optuna, your own, or grid for few gains; 16 points a round where they do not say, on a GPU
            256, and 60 or 100 rounds at most.
        members: walks of each law that no search has seen.
        seeds: searches of each law, from the seed of the settings on; 3 where None, on a GPU 8. One of a grid.
        out: a folder that keeps each finished round, so that an interrupted comparison goes on from there.
        stage: opened for each longer work, see `tuning.background.Stage`.
        method, metrics, engine: as of `tuning.tune`.

    Raises:
        ConfigError: an unknown law, a law twice, settings that make no sense, or a key of them that no law has.
        KeyboardInterrupt: the user stopped it.
        OutputError: the folder cannot be written, or holds unfinished searches for something else.
    """
    named = {} if method is None else {"method": method}
    wanted, own = tune.own_method(tune.over_ensemble(search, settings, ensemble), scenario, method)
    wanted = alike(wanted, search, settings, named)
    laws_by_name = contestants(scenario, laws, wanted, own)
    walks: dict[str, Any] = {"metrics": mc.MetricTable(metrics), "engine": engine, "own_method": own}
    base = problem_of(scenario, laws_by_name, ensemble, **walks)
    return run(laws_by_name, base, wanted, members, seeds_for(wanted, seeds), out=out, stage=stage)


def seeds_for(search: Search, asked: int | None) -> int:
    """Return how many searches each law has: one where they would all be the same."""
    if search.method == "grid":
        return 1
    return asked or (SEEDS_OF_MANY if execution.many_at_once(np.dtype(search.precision)) else SEEDS)


def alike(wanted: Search, *given: Search | Mapping[str, Any] | None) -> Search:
    """Return settings that search all laws alike; `given` say whether the method was chosen.

    Raises:
        ConfigError: a method that searches some laws longer than others, or joint gains that are not searched.
    """
    said = [each.model_fields_set if isinstance(each, Search) else each or () for each in given]
    if not any("method" in each for each in said):
        wanted = wanted.model_copy(update={"method": "cmaes"})
    if wanted.method != OWN_METHOD and method_of(wanted.method).gradients:
        raise ConfigError("", "method", "cmaes, optuna or grid, which search all laws alike", wanted.method)
    if wanted.joint_gains is False:
        raise ConfigError("", "joint_gains", "true, as pd has no gains but kp and kd", "false")
    if wanted.method == "grid":
        return wanted.model_copy(update={"joint_gains": True})
    points, rounds = MANY if execution.many_at_once(np.dtype(wanted.precision)) else FEW
    how = {"starts": wanted.starts or points, "iterations": wanted.iterations or rounds, "joint_gains": True}
    return wanted.model_copy(update=how)


def named(scenario: mc.Scenario, laws: Laws) -> dict[str, Place]:
    """Return scenario and law (None: the scenario's) by name, pd the last.

    Raises:
        ConfigError: an unknown law, a law twice, or none beside pd.
    """
    found: dict[str, Place] = {}
    own = without(scenario)
    for name, law in laws.items() if isinstance(laws, Mapping) else ((_name(law), law) for law in laws):
        if name in found or name in HARDWARE:
            raise ConfigError("", "laws", "laws of different names", f"{name.replace(NAME, 'pd')} twice")
        if name == NAME:
            found[name] = under_pd(scenario), None
        elif isinstance(law, mc.Law):
            found[name] = own, law
        elif law in CONTROLLERS:
            reading = scenario.control.reading if law == "base_admittance" else "virtual_model"
            found[name] = own.with_overrides({"control.controller": law, "control.reading": reading}), None
        else:
            try:
                found[name] = own, load_law(law)
            except ConfigError as error:
                raise ConfigError("", "laws", f"pd, {', '.join(CONTROLLERS)} or a law: {error}") from None
    if not found.keys() - {NAME}:
        raise ConfigError("", "laws", "a law to compare with pd", "none")
    last = found.pop(NAME, (under_pd(scenario), None))
    return found | {NAME: last}


def _with_plan(laws: dict[str, Place], search: Search) -> dict[str, Place]:
    """Return the laws with the best rival that reads no forces, where one of them reads forces.

    Not on a grid, which takes fewer gains than it has.
    """
    *others, last = laws.items()
    reading = (reads_forces(Problem(scenario, law=law)) for _, (scenario, law) in others)
    if PLANNED in laws or search.method == "grid" or not any(reading):
        return laws
    return dict([*others, (PLANNED, (without(last[1][0]), PlannedTransfer())), last])


def _name(law: str | mc.Law) -> str:
    if law in ("pd", PD.__name__) or type(law) is PD:
        return NAME
    return law.rpartition(":")[2] if isinstance(law, str) else type(law).__name__


def contestants(
    scenario: mc.Scenario, laws: Laws, search: Search, method: Method | None = None
) -> dict[str, Contestant]:
    """Return the laws by name, pd the last, each with the settings that concern it; errors as of `compare`.

    `method` is the user's own, where the settings say so.
    """
    found = {}
    for name, (place, law) in _with_plan(named(scenario, laws), search).items():
        own = _own(search, place, law)
        found[name] = Contestant(place, law, own, spaces.space(place, own, law))
        if search.method == "cmaes" and found[name].space.size == 1:
            raise ConfigError("", "method", f"optuna or grid where {name} has one gain to search", "cmaes")
        if search.method == "grid" and (size := found[name].space.size) > grid.Grid.most:
            expected = f"cmaes or optuna where {name} has {size} numbers to search"
            raise ConfigError("", "method", expected, f"grid, which takes {grid.Grid.most}")
        tune.check_method(own, method, found[name].space)
    for key in _KEYS:
        there = {gain for each in found.values() for gain in getattr(each.search, key)}
        for gain in (gain for gain in getattr(search, key) if gain not in there):
            setting = key if key == "also" else f"{key}.{gain}"
            raise ConfigError("", setting, "a gain that one of the laws has", gain)
    return found


def problem_of(scenario: mc.Scenario, laws: Mapping[str, Contestant], ensemble: Ensemble, **walks: Any) -> Problem:
    """Return the walks and the objective, the same for all laws; `walks`: metrics, engine and `own_method`."""
    return tune.problem_of(scenario, laws[NAME].search, ensemble=ensemble, **walks)


def _own(search: Search, scenario: mc.Scenario, law: mc.Law | None) -> Search:
    """Return the settings without the gains that a law does not have."""
    law = law or law_of(scenario)
    own = search.model_copy(update={"also": tuple(gain for gain in search.also if gain in spaces.added(law))})
    left: dict[str, Any] = {}
    for section, known in spaces.named_by(scenario, own, law).items():
        named = getattr(own, section)
        kept = [name for name in named if name in known]
        left[section] = {name: named[name] for name in kept} if isinstance(named, dict) else tuple(kept)
    return own.model_copy(update=left)


def run(
    laws: Mapping[str, Contestant],
    base: Problem,
    asked: Search,
    members: int = judging.MEMBERS,
    seeds: int = 1,
    *,
    out: str | os.PathLike[str] | None = None,
    stage: Stage = silent,
) -> Comparison:
    """Search and judge laws, see `contestants` and `problem_of`; other arguments, result and errors as of `compare`."""
    below = None if out is None else Path(out) / parts.FOLDER
    patience = PATIENCE * asked.starts if asked.starts and asked.method != "grid" else None
    found: dict[str, list[Tuned]] = {name: [] for name in laws}
    for name, (scenario, law, search, space) in laws.items():
        problem = dataclasses.replace(base, scenario=scenario, law=law, space=space)
        for number in range(seeds):
            own = search.model_copy(update={"seed": search.seed + number})
            drawn = tune.of_search(problem, own, number)
            kept = None if below is None else below / f"{file_name(name)}-{own.seed}"
            with stage(f"{name}, seed {own.seed}", unit="rounds", keeps=True) as told:
                found[name].append(tune.run(drawn, own, patience=patience, out=kept, progress=counted(told)))
                if found[name][-1].interrupted:
                    raise KeyboardInterrupt
    assert base.ensemble is not None
    unseen = judging.fresh(base.ensemble.model_copy(update={"members": members}))

    def by_seed(name: str, tuned: Iterable[Tuned]) -> dict[str, AnyGains]:
        return {f"{name}, seed {own.search.seed}": own.gains for own in tuned}

    draws = {name: judging.through(own[0].problem, by_seed(name, own), unseen) for name, own in found.items()}
    pd = draws[NAME]
    assert pd.problem.parameters is not None
    for name, parameters in on_better_hardware(pd.problem.scenario, pd.problem.parameters).items():
        better = dataclasses.replace(pd.problem, parameters=parameters)
        draws[name] = dataclasses.replace(pd, problem=better, gains=by_seed(name, found[NAME]))
    each, numbers = [], [own.search.seed for own in found[NAME]]
    for name, draw in draws.items():
        with stage(f"unseen walks of {name}", unit="members") as told:
            arrays = Rows(draw, None if below is None else below / f"judged-{file_name(name)}").walk(told)
        each.append(_of_one_law(draw.dataset(arrays), name, list(draw.gains), numbers))
        if name == next(iter(draws)):  # every draw has walked it
            scenarios_pd = _of_one_law(draw.dataset(arrays), judging.PD, [judging.PD] * seeds, numbers)
    lost = "; ".join(text for own in each if (text := own.attrs[judging.LOST_SENSORS]))
    data = xr.concat(
        [*each, scenarios_pd], "gains", data_vars="minimal", coords="minimal", compat="override",
        combine_attrs="override",
    )  # fmt: skip
    of_searches = {f"search_{field}": _of_searches(found, field, data) for field in ("value", "feasible", "converged")}
    data = data.assign_attrs({judging.LOST_SENSORS: lost}).assign(of_searches)
    return Comparison(data, base, asked, base.ensemble, searched={name: tuple(own) for name, own in found.items()})


def _of_searches(found: Mapping[str, Sequence[Tuned]], field: str, data: xr.Dataset) -> xr.DataArray:
    """Return a property of all searches as numbers, (gains, seed): NaN of gains that were not searched."""
    none = [np.nan] * data.sizes["seed"]
    values = [[float(getattr(own, field)) for own in found.get(name, ())] or none for name in data["gains"].values]
    return xr.DataArray(values, dims=("gains", "seed"), attrs={"units": "1", "long_name": f"{field} of the search"})


def _of_one_law(walks: xr.Dataset, name: str, gains: list[str], seeds: list[int]) -> xr.Dataset:
    """Return the walks of some gains as those of one law over the seeds of its searches."""
    own = walks.sel(gains=gains).assign_coords(gains=seeds).rename(gains="seed")
    return own.map(lambda each: each.expand_dims(gains=[name]) if "seed" in each.dims else each, keep_attrs=True)


def on_better_hardware(scenario: mc.Scenario, drawn: mc.Parameters) -> dict[str, mc.Parameters]:
    """Return the parameters of a draw with one thing bettered, by its name, as far as the hardware has such.

    Control periods stay whole time steps, one at least.
    """
    there = {words: scalable(drawn, paths_of(drawn, word)) for words, word in HARDWARE.items()}
    half = {words: dict.fromkeys(paths, Factor(0.5)) for words, paths in there.items() if paths}
    return {words: changed(drawn, changes, scenario.time_step) for words, changes in half.items()}


def file_name(law: str) -> str:
    """Return the name of a law's files."""
    return re.sub(r"[^\w.@+-]", "_", law)
