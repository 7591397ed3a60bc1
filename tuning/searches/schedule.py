"""A gain schedule: which gains to load under which gravity and with which cargo.

All operating points are tuned side by side in one batch, each under its own gravity and cargo and against its own pd.
Then every point tries the gains of all others, takes them where they are better, and goes on from there.
"""

import dataclasses
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
import xarray as xr
import yaml

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.dynamics import STANDARD_GRAVITY as EARTH
from mjx_climb.files import dataset
from mjx_climb.quantities.parameters import own_numbers
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.gains_file import by_name
from tuning.gains.labels import axes_of, labelled
from tuning.problem import objectives, spaces
from tuning.problem import search as search_settings
from tuning.problem.evaluation import Evaluation, Problem, under_pd
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Search
from tuning.problem.spaces import to_gains64
from tuning.searches import retuned_pd, tune
from tuning.searches.judged_rounds import Rounds, Told
from tuning.searches.methods import Task, gradient
from tuning.searches.robust import pd_of

G = -EARTH[2]  # m/s^2
GRAVITIES = (1e-6, 1e-2, 1 / 6, 0.38, 1.0)  # G: orbit, a small body, Moon, Mars, Earth
CARGO = (0.0, 0.5, 1.0)  # kg
CANDIDATES = 24  # random points per operating point
ITERATIONS = (10, 8)  # of the two descents
_VARIED = ("gravity", "cargo_mass")
_Row = TypeVar("_Row", Term, Limit)


class OperatingPoints(NamedTuple):
    """What is tuned side by side, P pairs of gravity and cargo, the cargo running fastest."""

    problem: Problem  # of all of them, a row each
    search: Search
    goals: list[Objective]  # (P,) each relative to pd there
    numbers: mc.Parameters  # gravity (P, 3), cargo (P,)
    gravity: tuple[float, ...]  # G
    cargo: tuple[float, ...]  # kg

    def at(self, places: np.ndarray) -> Problem:
        """Return the problem whose rows are at some of the points."""
        rows = {n: v[places] if n in _VARIED else v for n, v in vars(self.numbers).items()}
        objective = _rows([self.goals[place] for place in places])
        return dataclasses.replace(self.problem, numbers=mc.Parameters(**rows), objective=objective)


def schedule(
    scenario: mc.Scenario,
    settings: Search | None = None,
    *,
    gravity: Sequence[float] = GRAVITIES,
    cargo: Sequence[float] = CARGO,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    out: Path | None = None,
    progress: Told | None = None,
    **changes: Any,
) -> xr.Dataset:
    """Tune gains for every pair of gravity and cargo.

    Arguments:
        scenario: what walks where; its gravity gives the direction alone, its cargo the window of time alone.
        settings: space, bounds, weights, limits and seed (the method is not used); `changes` replace keys of it.
        gravity: G, ascending.
        cargo: kg, ascending.
        law: whose gains are tuned, the scenario's where None.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        engine: the dynamics.
        out: a folder that keeps finished rounds, so that an interrupted search goes on.
        progress: called after each round.

    Returns:
        Over `gravity` and `cargo` the gains, `value` (1 for pd at that point), `feasible`; with `walk` (tuned,
        config, retuned_pd, pd) every metric, in float64 with grippers that tear off; `retuned_kp`, `retuned_kd` and
        `retuned_value` of pd with the best of a grid of joint gains at each point; with `gravity_of` and `cargo_of` the
        `value` (`transfer`) that the gains of another operating point have here, NaN where they break a constraint.

    Raises:
        ConfigError: operating points that are not in order, or pd has no value of a metric that is weighed.
    """
    settings = tune.changed(settings, changes)
    points = operating_points(scenario, settings, gravity, cargo, law=law, metrics=metrics, engine=engine)
    return run(points, out=out, progress=progress)


def operating_points(
    scenario: mc.Scenario,
    settings: Search,
    gravity: Sequence[float] = GRAVITIES,
    cargo: Sequence[float] = CARGO,
    *,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
) -> OperatingPoints:
    """Return what `schedule` tunes; pd walks at each point first.

    Raises:
        ConfigError: see `schedule`.
    """
    for name, values, least in (("gravity", gravity, 0.0), ("cargo", cargo, -1e-12)):
        if not len(values) or not np.isfinite(values).all() or min(values) <= least or (np.diff(values) <= 0).any():
            raise ConfigError(f"{name}: expected ascending numbers, got {', '.join(f'{v:g}' for v in values)}")
    table = tune.complete(metrics)
    search_settings.check_metrics(settings, table)
    numbers = _numbers(scenario, gravity, cargo)
    baseline = pd_of(scenario, numbers, engine=engine, metrics=table)
    count = len(gravity) * len(cargo)
    goals = [
        objective_at(scenario, settings, {n: float(v[p]) for n, v in baseline.items()}, table) for p in range(count)
    ]
    space, dtype = spaces.space(scenario, settings, law), np.dtype(settings.precision).type
    problem = Problem(scenario, space, _rows(goals), dtype=dtype, engine=engine, metrics=table, law=law)
    return OperatingPoints(problem, settings, goals, numbers, tuple(gravity), tuple(cargo))


def run(asked: OperatingPoints, *, out: Path | None = None, progress: Told | None = None) -> xr.Dataset:
    """Tune the gains of all operating points; arguments and result as of `schedule`."""
    problem, settings, points = asked.problem, asked.search, len(asked.goals)
    space, rng = problem.space, np.random.default_rng(settings.seed)
    own = tune.start_of(problem)
    identity = {
        **tune.search_identity(problem, settings), "operating_points": [list(asked.gravity), list(asked.cargo)],
    }  # fmt: skip
    rounds = Rounds(1 + sum(ITERATIONS) + 2, progress, out, identity)

    best, merit = np.tile(own, (points, 1)), np.full(points, np.inf)

    def take(theta: np.ndarray, found: Evaluation, places: np.ndarray) -> None:
        """Keep the best point of every operating point."""
        ranks = np.where(found.feasible, found.value, 1e3 + found.merit)
        for row, place in enumerate(places):
            if ranks[row] < merit[place]:
                best[place], merit[place] = theta[row], ranks[row]

    drawn = np.concatenate([own[None], space.draw_tied(rng, CANDIDATES - 1)])
    places = np.repeat(np.arange(points), CANDIDATES)
    theta = np.tile(drawn, (points, 1))
    take(theta, rounds.evaluate(asked.at(places), theta, "random points"), places)

    here = np.arange(points)
    pairs = np.repeat(here, points), np.tile(here, points)  # operating point, whose gains
    for number, iterations in enumerate(ITERATIONS):
        ties = np.eye(space.size) if number and len(space.ties) < space.size else space.ties
        walks, phase = asked.at(here), f"descent {number + 1} of {len(ITERATIONS)}"
        task = Task(walks, settings, own)
        moves = gradient.descend(task, best.copy(), ties, iterations, rng, phase, np.full(points, 0.5 * 0.6**number))
        for step in rounds.descend(walks, moves):
            take(step.theta, step.found, here)
        theta = best[pairs[1]]
        crossed = rounds.evaluate(asked.at(pairs[0]), theta, "gains of the neighbours")
        take(theta, crossed, pairs[0])
    transfer = np.where(crossed.feasible, crossed.value, np.nan).reshape(points, points)
    return _dataset(asked, best, merit, transfer, rounds.env_steps)


def objective_at(
    scenario: mc.Scenario, settings: Search, baseline: dict[str, float], metrics: mc.MetricTable = mc.METRICS
) -> Objective:
    """Return the objective of one operating point relative to pd there.

    A limit on the base's deviation that follows from pd's is at least a millimetre: without cargo or weight pd hardly
    sags.
    """
    plain = objectives.objective(scenario, settings, baseline, metrics=metrics)
    limits = [
        limit._replace(value=max(limit.value, 1e-3), scale=max(limit.scale, 1e-3))
        if limit.metric == "base_deviation" and "base_deviation" not in settings.limits
        else limit
        for limit in plain.limits
    ]
    return dataclasses.replace(plain, limits=tuple(limits))


def _rows(rows: Sequence[Objective]) -> Objective:
    """Return one objective for a batch whose rows have their own."""

    def joined(kind: type[_Row], items: Sequence[_Row]) -> _Row:
        merged: dict[str, Any] = {name: tuple(getattr(item, name) for item in items) for name in kind._fields}
        same = {name: values[0] for name, values in merged.items() if isinstance(values[0], str)}
        same |= {name: merged[name][0] for name in ("weight", "margin", "larger_is_better") if name in merged}
        return kind(**{**merged, **same})

    terms = tuple(joined(Term, items) for items in zip(*(row.terms for row in rows), strict=True))
    limits = tuple(joined(Limit, items) for items in zip(*(row.limits for row in rows), strict=True))
    return Objective(terms, limits)


def _numbers(scenario: mc.Scenario, gravity: Sequence[float], cargo: Sequence[float]) -> mc.Parameters:
    """Return the numbers of all operating points, gravity (P, 3) and cargo (P,), the cargo running fastest."""
    down = np.asarray(scenario.gravity, float)
    length = np.linalg.norm(down)
    down = down / length if length > 0 else np.array([0.0, 0.0, -1.0])
    level, load = np.meshgrid(gravity, cargo, indexing="ij")
    gravities = G * level.reshape(-1, 1) * down
    return dataclasses.replace(own_numbers(scenario), gravity=gravities, cargo_mass=load.ravel())


def _dataset(
    asked: OperatingPoints, theta: np.ndarray, merit: np.ndarray, transfer: np.ndarray, spent: int
) -> xr.Dataset:
    problem = asked.problem
    scenario, space, table, law = problem.scenario, problem.space, problem.metrics, problem.law
    shape = (len(asked.gravity), len(asked.cargo))
    gains = to_gains64(space, theta)
    pd, (joint, without) = under_pd(scenario), _retuned(asked)
    own = {name: np.full(len(theta), float(getattr(scenario.control, name))) for name in joint}  # pd's one program
    walkers: dict[str, tuple[mc.Scenario, AnyGains | None, mc.Law | None]]
    walkers = {
        "tuned": (scenario, gains, law), "config": (scenario, None, law),
        retuned_pd.NAME: (pd, joint, None), "pd": (pd, own, None),
    }  # fmt: skip
    how: dict[str, Any] = {"metrics": table, "dtype": np.float64, "engine": problem.engine}
    metrics = [mc.rollout_metrics(s, g, asked.numbers, law=own, **how) for s, g, own in walkers.values()]
    values = {name: value.reshape(*shape, *value.shape[1:]) for name, value in by_name(gains).items()}
    tuned = labelled(values, ("gravity", "cargo"), law)
    data: dict[str, Any] = dict(tuned)
    data["value"] = (("gravity", "cargo"), np.where(merit < 1e3, merit, np.nan).reshape(shape), {"units": "1"})
    data["feasible"] = (("gravity", "cargo"), (merit < 1e3).reshape(shape), {"units": "1"})
    data["transfer"] = (("gravity", "cargo", "gravity_of", "cargo_of"), transfer.reshape(shape * 2), {"units": "1"})
    for name, of_each in (*joint.items(), ("value", without)):
        units = dataset.COORDINATES[name][0] if name in joint else "1"
        data[f"retuned_{name}"] = (("gravity", "cargo"), of_each.reshape(shape), {"units": units})
    bounds = [", ".join(space.on_bound(point)) for point in theta]
    data["on_bound"] = (("gravity", "cargo"), np.array(bounds, str).reshape(shape), {"long_name": "gains on a bound"})
    for metric in table:
        values_of = np.stack([m[metric.name].reshape(shape) for m in metrics])
        data[metric.name] = (("walk", "gravity", "cargo"), values_of, dataset.metric_attributes(metric))
    coordinates = {
        "gravity": ("gravity", np.asarray(asked.gravity, float), {"units": "G", "long_name": "gravity"}),
        "cargo": ("cargo", np.asarray(asked.cargo, float), {"units": "kg", "long_name": "mass of the cargo"}),
        "gravity_of": np.asarray(asked.gravity, float),
        "cargo_of": np.asarray(asked.cargo, float),
        "walk": list(walkers),
    }
    attrs = {"title": "gain schedule", "search": asked.search.to_yaml(), "env_steps": spent}
    attrs |= {"space": " ".join(space.names), "gains": " ".join(tuned), "searched": " ".join(space.gains)}
    return xr.Dataset(data, coordinates | axes_of(tuned), {**attrs, **dataset.provenance(scenario)})


def _retuned(asked: OperatingPoints) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return kp and kd, (P,) each, with which pd is best at each point, of a grid, and what it is worth, 1 for pd."""
    problem = asked.problem
    how: dict[str, Any] = {"dtype": problem.dtype, "engine": problem.engine}
    gains, walks = retuned_pd.walked_on_grid(problem.scenario, problem.metrics, numbers=asked.numbers, **how)
    score = problem.objective.score({name: jnp.asarray(values) for name, values in walks.items()})
    value, feasible = np.asarray(score.value), np.asarray(score.feasible)
    ranks = np.where(feasible, value, 1e3 + value + np.asarray(score.penalty))
    best = np.nan_to_num(ranks, nan=np.inf).argmin(0)
    here = best, np.arange(len(best))
    return {name: values[best] for name, values in gains.items()}, np.where(feasible[here], value[here], np.nan)


def worth(table: xr.Dataset) -> str:
    """Return in a sentence what a force sensor is worth: the gains against pd with joint gains for each point."""
    ratio = (table["value"] / table["retuned_value"]).values
    known = ratio[np.isfinite(ratio)]
    if not known.size:
        return "the force sensor: not to be compared with pd, which keeps the limits at no operating point"
    none = f"no verdict on the force sensor, since pd was searched {retuned_pd.ON_A_GRID}"
    verdict = none if (known < 1).any() else "the force sensor does not pay"
    span = " to ".join(dict.fromkeys(f"{end:.3f}" for end in (known.min(), known.max())))
    return (
        f"{verdict}: less objective at {(known < 1).sum()} of {known.size} operating points, {span} "
        "times that of pd with kp and kd for each, which needs none"
    )


def gain_names(table: xr.Dataset) -> list[str]:
    """Return the names of the gains that a schedule holds."""
    return list(table.attrs["gains"].split())


def lookup(table: xr.Dataset, gravity: float, cargo: float) -> AnyGains:
    """Return the gains between the operating points: logarithms, linear in log gravity and in cargo, held at the ends.

    Arguments:
        table: what `schedule` gave.
        gravity: G.
        cargo: kg.
    """

    def between(name: str) -> np.ndarray:
        values = table[name].values
        logs = np.log(values.reshape(table.sizes["gravity"], table.sizes["cargo"], -1))
        loads, levels = table["cargo"].values, np.log(table["gravity"].values)
        at_cargo = [[np.interp(cargo, loads, logs[g, :, i]) for i in range(logs.shape[2])] for g in range(len(logs))]
        found = np.exp([np.interp(math.log(gravity), levels, column) for column in np.transpose(at_cargo)])
        return found if values.ndim > 2 else found[0]

    return spaces.as_gains({name: between(name) for name in gain_names(table)})


def one_for_all(table: xr.Dataset) -> tuple[float, float, float]:
    """Return the operating point, gravity G and cargo kg, whose gains serve all others best, and the most they lose.

    The loss is the largest `transfer` less the tuned `value` over all operating points; infinite where every set of
    gains breaks a constraint somewhere.
    """
    loss = table["transfer"].values - table["value"].values[:, :, None, None]
    worst = np.where(np.isfinite(loss), loss, np.inf).max((0, 1))
    g, c = np.unravel_index(np.argmin(worst), worst.shape)
    return float(table["gravity"][g]), float(table["cargo"][c]), float(worst[g, c])


def rows(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return the schedule as plain rows: gravity_g, cargo_kg, the gains, and what they change against pd."""
    result = []
    for g in range(table.sizes["gravity"]):
        for c in range(table.sizes["cargo"]):
            point = table.isel(gravity=g, cargo=c)
            row: dict[str, Any] = {"gravity_g": float(point["gravity"]), "cargo_kg": float(point["cargo"])}
            for name in gain_names(table):
                values = np.unique(np.round(point[name].values.ravel(), 12))
                row[name] = float(values[0]) if values.size == 1 else point[name].values.tolist()
            row["feasible"], row["on_bound"] = bool(point["feasible"]), point["on_bound"].item()
            for name in ("force_variation", "peak_foot_force", "peak_pull_force", "base_deviation"):
                row[name] = {walk: float(point[name].sel(walk=walk)) for walk in table["walk"].values.tolist()}
            row[retuned_pd.NAME] = {name: float(point[f"retuned_{name}"]) for name in ("kp", "kd", "value")}
            result.append(row)
    return result


def to_csv(table: xr.Dataset) -> str:
    """Return the schedule as CSV: one line per operating point, a column per axis of each gain."""
    text = io.StringIO()
    gains = {name: [f"{name}_{axis}" for axis in _axes(table[name])] or [name] for name in gain_names(table)}
    metrics = ("force_variation", "peak_foot_force", "peak_pull_force", "base_deviation")
    walks = table["walk"].values.tolist()
    columns = [column for names in gains.values() for column in names]
    head = ["gravity_G", "cargo_kg", *columns, "feasible", *(f"{name}_{walk}" for name in metrics for walk in walks)]
    text.write(",".join(head) + "\n")
    for g, level in enumerate(table["gravity"].values):
        for c, load in enumerate(table["cargo"].values):
            point = table.isel(gravity=g, cargo=c)
            values = [level, load, *np.concatenate([point[name].values.ravel() for name in gains])]
            tail = [point[name].sel(walk=walk).item() for name in metrics for walk in walks]
            cells = [f"{v:.6g}" for v in values] + [str(int(point["feasible"]))] + [f"{v:.6g}" for v in tail]
            text.write(",".join(cells) + "\n")
    return text.getvalue()


def _axes(gain: xr.DataArray) -> list[str]:
    """Return the names of a gain's axes, none for one of a single number."""
    return [] if gain.ndim == 2 else [str(axis) for axis in gain[gain.dims[-1]].values]


def to_yaml(table: xr.Dataset) -> str:
    """Return the schedule as YAML: a list of operating points with their gains."""
    return yaml.safe_dump({"operating_points": rows(table)}, sort_keys=False, default_flow_style=None, width=110)
