"""Folders of made-up searches, whole: files, page and pictures against texts that were read and computed by hand."""

import contextlib
import dataclasses
import types

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import LoadTransfer
from mjx_climb.files import dataset
from mjx_climb.walks import LINES
from tests import approved
from tests.trajectories import still
from tests.tuning.pages.made_up import CASE, HERE, PROBLEM, drawn_again, same, table_of
from tests.tuning.pages.test_ceiling import bounded
from tuning.comparisons import verification
from tuning.comparisons.of_front import FrontComparison, verdict
from tuning.comparisons.of_laws import LawsComparison
from tuning.comparisons.of_schedule import ScheduleComparison
from tuning.comparisons.of_search import TuneComparison
from tuning.comparisons.of_sweep import SweepComparison
from tuning.comparisons.paired import Verdict
from tuning.comparisons.side_by_side import AtOneStep
from tuning.comparisons.worth import Worth
from tuning.pages import ceiling, comparison, laws, pareto, schedule, sweep, tune
from tuning.problem.evaluation import Problem
from tuning.problem.search import Pareto, Search
from tuning.problem.spaces import space
from tuning.results.front import Front
from tuning.results.judged import Comparison
from tuning.results.scheduled import Scheduled
from tuning.results.swept import Swept, best_cell
from tuning.results.tuned import AGREEMENT, Tuned

HELD = {"diverged": False, "detached_limb": None, "detached_at": None, "stands_at": None}
TORN = {"detached_limb": "LF", "detached_at": 0.12}


def metrics_of(level, **changes):
    """The metrics of a walk that holds: the level and more by the place of each."""
    each = {metric.name: level + 0.5 * place for place, metric in enumerate(mc.METRICS)}
    return each | HELD | {"missed_grips": 0, "base_deviation": 0.001 * level} | changes


def points_of(columns, names, **attrs):
    """The points of a search; the coordinates are 0.1, 0.2, ... of the first, twice that of the next."""
    count = len(columns["value"])
    data = xr.Dataset({name: ("point", np.array(each)) for name, each in columns.items()})
    theta = 0.1 * np.arange(1, count + 1)[:, None] * np.arange(1, len(names) + 1)
    data["theta"] = (("point", "coordinate"), 4 + theta)
    return data.assign_coords(coordinate=list(names), point=np.arange(count)).assign_attrs(interrupted=0, **attrs)


POINTS = {
    "value": [1.2, 0.9, 0.8, 0.7, np.nan, 0.75], "penalty": [0.0, 0.0, 0.2, 0.0, np.inf, 0.0],
    "feasible": [True, True, False, True, False, True], "env_steps": [1000, 2000, 3000, 4000, 5000, 6000],
    "gradient_norm": [np.nan, 3.0, 2.0, 1.0, np.nan, 0.5], "round": [0, 1, 1, 2, 2, 3], "row": [0, 0, 1, 0, 1, 0],
    "phase": ["first", "descent", "descent", "descent", "descent", "population"],
}  # fmt: skip
STILL = still(CASE, base_position=0.002, foot_force=np.array([0.0, 3.0, 4.0]))


def found_by(law=None, seed=0, names=("stiffness", "damping"), **columns):
    problem = dataclasses.replace(PROBLEM, law=law, ensemble=None)
    if law is not None:
        problem = dataclasses.replace(problem, space=space(CASE, Search(), law))
    gains = mc.Gains(1.0, 50.0, 2e3) if law is None else {name: 0.5 for name in law.GAINS}
    return Tuned(points_of({**POINTS, **columns}, names), problem, Search(seed=seed), gains=gains)


@pytest.mark.parametrize("told", [True, False])
def test_the_folder_of_laws(told, tmp_path):
    names = ["base_admittance", "mine", "retuned_pd", "half the delay", "pd"]
    searches = {"base_admittance": (None, 3), "mine": (LoadTransfer(), 2), "retuned_pd": (None, 2)}
    searched = {name: tuple(found_by(law, seed) for seed in range(count)) for name, (law, count) in searches.items()}
    if not told:
        names.remove("half the delay")
        one = found_by(LoadTransfer(), 0, feasible=[False] * 6)
        searched = {name: each[:1] for name, each in searched.items()} | {"mine": (one,)}
        searched["retuned_pd"][0].data.attrs["converged"] = 0
    table = table_of(names, ["force_variation", "travel"], "retuned_pd")
    table.attrs["seeds"] = 3 if told else 1
    data = xr.Dataset(coords={"gains": names, "seed": [0, 1, 2], "member": range(5)})
    if told:
        table.attrs["members_compared"] = table.attrs["members"]
    found = Comparison(data, PROBLEM, Search(seed=7), PROBLEM.ensemble, searched=searched)
    compared = LawsComparison(table, Verdict("mine" if told else None, "mine is better"), ["mine"])
    made = same(f"laws_{told}", laws.contents(found, compared, "case.yaml"))
    if told:
        drawn_again("laws_True", made, tmp_path)


@pytest.mark.parametrize("told", [True, False])
def test_the_folder_of_a_schedule(told, tmp_path):
    """Of three levels of gravity and two loads; gains that differ between axes, an array, one that breaks limits."""
    gravity, cargo = np.array([0.05, 0.5, 1.0]), np.array([0.0, 1.5])
    shape, walks = (3, 2), ["tuned", "config", "retuned_pd", *(["planned_unsearched"] if told else []), "pd"]
    grid = 1 + np.arange(6.0).reshape(shape)
    dims = ("gravity", "cargo")
    six = grid[..., None] * np.array([100.0] * 3 + [10.0 if told else 100.0] * 3)
    data = {
        "stiffness": ((*dims, "six"), six, {"units": "N/m"}),
        "damping": ((*dims, "six"), np.repeat(grid[..., None], 6, -1), {"units": "N s/m"}),
        "weights": ((*dims, "row", "column"), grid[..., None, None] * np.array([[1, 2], [2, 4.0]]), {"units": "1"}),
        "value": (dims, 0.1 * grid), "feasible": (dims, grid != 3),
        "on_bound": (dims, np.where(grid == 2, "damping", "")),
        "retuned_kp": (dims, 10 * grid), "retuned_kd": (dims, grid), "retuned_value": (dims, 0.2 * grid),
    }  # fmt: skip
    transfer = 0.1 * grid[:, :, None, None] + 0.02 + 0.01 * abs(grid - 4)
    if not told:
        transfer[0] = np.nan
    data["transfer"] = ((*dims, "gravity_of", "cargo_of"), transfer)
    level = np.arange(1, len(walks) + 1)[:, None, None] * grid
    for place, name in enumerate(schedule.SHOWN):
        data[name] = (("walk", *dims), level + place, {"units": "N"})
    limb = np.full(level.shape, -1)
    limb[0, 0, 0], limb[1, 2, 1] = 1, 2
    data["detached_limb"] = (("walk", *dims), limb)
    data["diverged"] = (("walk", *dims), np.zeros(level.shape, bool))
    names = ["stiffness", "damping", "weights"]
    coordinates = {"gravity": gravity, "cargo": cargo, "walk": walks, "six": ["x", "y", "z", "rx", "ry", "rz"]}
    coordinates |= {"row": [0, 1], "column": [0, 1]}
    found = Scheduled(
        xr.Dataset(data, coordinates, {"searched": " ".join(names), "gains": " ".join(names)}), PROBLEM, Search(seed=2)
    )
    compared = ScheduleComparison("the worth", "the verdict")
    made = same(f"schedule_{told}", schedule.contents(found, compared, "case.yaml"))
    if told:
        drawn_again("schedule_True", made, tmp_path)


@pytest.mark.parametrize("told", [True, False])
def test_the_folder_of_a_front(told, tmp_path):
    """The knee of five points is the fourth; a rival without a sensor costs no more than it, or all cost more."""
    better, against, count = "force_variation", "base_deviation", 5
    x, y = np.array([1.0, 2.0, 3.0, 4.0, 40.0 if told else 8.0]) * 1e-3, np.array([90.0, 60.0, 40.0, 20.0, 15.0])
    data = {
        metric.name: ("front", place + np.arange(count, dtype=float), dataset.metric_attributes(metric))
        for place, metric in enumerate(mc.METRICS)
    }
    held = {"diverged": 0.0, "detached_limb": -1.0, "detached_at": np.nan, "stands_at": np.nan}
    data |= {name: ("front", np.full(count, value), data[name][2]) for name, value in held.items()}
    for name, values in ((better, y), (against, x)):
        data[name] = ("front", values, data[name][2])
        data[f"walked_{name}"] = ("point", np.array([1.0, 2.0, 3.0]) * values[0])
        data[f"reference_{name}"] = ("reference", np.array([2.0, 3.0]) * values[2])
        data[f"without_{name}"] = ("without", np.array([0.5, 2.0]) * values[3] * (1 if told else 4))
    data |= {"held": ("point", np.array([True, False, True])), "without_kp": ("without", np.array([30.0, 10.0]))}
    data |= {"without_kd": ("without", np.array([0.5, 0.25]))}
    data |= {"stiffness": (("front", "six"), np.arange(1.0, 6)[:, None] * np.ones(6))}
    data |= {"damping": (("front", "six"), np.arange(1.0, 6)[:, None] * np.arange(1.0, 7))}
    for name, value in (("detached_limb", [-1, 0]), ("diverged", [0, 0])):
        data[f"reference_{name}"] = ("reference", np.array(value))
    if told:
        data["without_law"] = ("without", np.array(["retuned_pd", "planned_unsearched"]))
    attrs = {"better": better, "against": against, "searched": "stiffness damping", "gains": "stiffness damping"}
    coordinates = {"reference": ["config", "pd"], "six": ["x", "y", "z", "rx", "ry", "rz"]}
    asked = Pareto(better=better, against=against, points=3)
    gains = mc.Gains(1.0, 50.0, 2e3)
    found = Front(xr.Dataset(data, coordinates, attrs), PROBLEM, Search(seed=3), gains=gains, asked=asked)
    kept = {name: np.zeros((count, 2, 3)) for name in LINES}
    metrics = {name: mc.metrics(STILL, PROBLEM.metrics) for name in ("pd", "config")}
    walks = dict.fromkeys(metrics, STILL)
    compared = FrontComparison(walks, metrics, kept, "what the sensor is worth", verdict(found, metrics))
    made = same(f"front_{told}", pareto.contents(found, compared, "case.yaml"))
    if told:
        drawn_again("front_True", made, tmp_path)


def grid_of(lost=False):
    """A grid of two by three walks: the force varies by 10 to 60 N, the least where a limb lets go."""
    shape, dims = (2, 3), ("stiffness", "damping")
    cells = np.arange(1.0, 7).reshape(shape)
    data = {}
    for place, metric in enumerate(mc.METRICS):
        data[metric.name] = (dims, cells + place, dataset.metric_attributes(metric))
    limb, at = np.full(shape, -1), np.full(shape, np.nan)
    limb[0, 0], at[0, 0] = (1, 0.1)
    if lost:
        limb[:], at[:] = 1, 0.1
    flags = {"flag_meanings": "none LF LH RH RF", "flag_values": [-1, 0, 1, 2, 3]}
    data["detached_limb"] = (dims, limb, data["detached_limb"][2] | flags)
    data["detached_at"] = (dims, at, data["detached_at"][2])
    data["stands_at"] = (dims, np.full(shape, np.nan), data["stands_at"][2])
    for name in ("diverged", "missed_grips"):
        data[name] = (dims, np.zeros(shape, int), data[name][2])
    data["force_variation"] = (dims, 10 * cells, data["force_variation"][2])
    about = {"stiffness": "N/m, N m/rad", "damping": "N s/m, N m s/rad"}
    values = {"stiffness": [1e2, 1e3], "damping": [1.0, 10.0, 100.0]}
    axes = {name: (name, values[name], {"units": units, "long_name": name}) for name, units in about.items()}
    grid = xr.Dataset(data, axes, {"dtype": "float32", "engine": "limb", "batch_size": 6})
    lines = {name: ((*dims, "extreme", "stretch"), np.zeros((*shape, 2, 3))) for name in LINES}
    return grid.assign(lines)


@pytest.mark.parametrize("told", [True, False])
def test_the_folder_of_a_sweep(told, tmp_path):
    grid = grid_of(lost=not told)
    best = best_cell(grid)
    radius = 1 + 1e-4 * (np.log10(grid["stiffness"]) - 2.5) + 0 * grid["damping"]
    grid = grid.assign(spectral_radius=radius)
    rows = {
        "best": ({"stiffness": 100.0, "damping": 10.0}, metrics_of(20.0, missed_grips=2)),
        "retuned_pd": ({"kp": 17.0, "kd": 1.0}, metrics_of(15.0)),
        "config": ({"stiffness": np.full(6, 5e4), "damping": np.full(6, 5e3)}, metrics_of(30.0, **TORN)),
        "pd": (None, metrics_of(10.0)),
    }
    if not told:
        rows = {"paper": ({"stiffness": 1.0}, metrics_of(30.0, diverged=True)), "pd": (None, metrics_of(10.0, **TORN))}
    worth = Worth({"force_variation": 0.5}, "the force sensor does not pay") if told else None
    level = AtOneStep(5e-4, 0.125) if told else None
    histories = grid.isel(damping=[1]) if told else grid
    compared = SweepComparison(
        grid, best, dict.fromkeys(rows, STILL), rows, 1 if told else 6, ["damping"] if told else [], worth,
        "the verdict", level, histories, [] if told else ["config: shorten the stride"],
    )  # fmt: skip
    made = same(f"sweep_{told}", sweep.contents(Swept(grid, Problem(CASE)), compared, "case.yaml"))
    if told:
        drawn_again("sweep_True", made, tmp_path)


def test_a_sheet_that_was_drawn_ahead_is_taken_unless_other_gains_or_values_are_marked():
    grid, pd = grid_of(), (None, metrics_of(10.0))
    rows = {"best": ({"stiffness": 100.0, "damping": 10.0}, metrics_of(20.0)), "pd": pd}
    drawn = sweep.Drawn(sweep.sheet(grid, rows), sweep._marked(grid, rows))
    assert sweep.sheet(grid, rows | {"retuned_pd": ({"kp": 17.0}, metrics_of(15.0))}, drawn) is drawn.figure
    assert sweep.sheet(grid, rows | {"pd": (None, metrics_of(11.0))}, drawn) is not drawn.figure
    moved = ({"stiffness": 1000.0, "damping": 10.0}, metrics_of(20.0))
    assert sweep.sheet(grid, rows | {"best": moved}, drawn) is not drawn.figure


def test_the_folder_of_a_sweep_before_it_is_compared():
    named = {"config": metrics_of(30.0), "pd": metrics_of(80.0, **TORN)}
    same("sweep_first", sweep.first(Swept(grid_of(), Problem(CASE)), named))
    assert sweep.first(Swept(grid_of(lost=True), Problem(CASE)), named) is None


@pytest.mark.parametrize("told", [True, False])
def test_the_folder_of_a_search(told):
    found = found_by()
    if told:
        found = dataclasses.replace(found, data=found.data.assign_attrs({AGREEMENT: "2 seeds agree"}))
    held = metrics_of(30.0, base_deviation=0.001)
    rows = {
        "tuned": ({"inertia": 1.0, "damping": 50.0, "stiffness": 2e3}, metrics_of(20.0)),
        "retuned_pd": ({"kp": 17.0, "kd": 1.0}, metrics_of(25.0)),
        "config": ({"inertia": 1.0, "damping": 5e3, "stiffness": 5e4}, metrics_of(30.0, **TORN) if told else held),
        "pd": (None, metrics_of(10.0)),
    }
    own = verification.Verification(
        metrics=metrics_of(20.0), value=0.71, search_value=0.7, broken_limits=["base deviation 0.02"] if told else [],
        binding_limits=[] if told else ["base deviation 0.0099"], less={"stiffness": None, "damping": -0.01},
        more={"stiffness": 0.2, "damping": 0.03}, shape={"stiffness": "cliff", "damping": "slope"},
        slopes={"stiffness": 0.25, "damping": -0.5} if told else {}, grid_value=0.72 if told else None,
        grid_gains={"stiffness": 1.0} if told else None, spectral_radius=0.99, margins={},
        warnings=["damping lies on a bound"] if told else [],
    )  # fmt: skip
    margin = verification.Margin(0.0, 8e-3, None, 0.03, "force delay")
    own = dataclasses.replace(own, margins={"force_delay": margin} if told else {})
    over = None
    if told:
        grid = grid_of()
        scores = {"objective": grid["force_variation"] / 100, "feasible": grid["detached_limb"] < 0}
        scores["spectral_radius"] = 1 + 1e-4 * (np.log10(grid["stiffness"]) - 2.5) + 0 * grid["damping"]
        over = grid.assign(scores)
        over["objective"].attrs = {"units": "1", "long_name": "objective, 1 for pd"}
        over["feasible"].attrs = {"units": "1", "long_name": "keeps every limit"}
    moved = np.zeros((CASE.steps, 6))
    moved[5, 1], moved[7, 4] = 0.002, 0.003
    walks = {name: STILL for name in rows} | {"tuned": dataclasses.replace(STILL, base_displacement=moved * told)}
    worth = Worth({"objective": -0.2}, "the force sensor pays") if told else None
    hardware = types.SimpleNamespace(margins={}, walks=None)
    broken = {
        "tuned": own.broken_limits, "retuned_pd": ["base deviation 0.025, limit 0.01 (as asked)"], "pd": [],
        "config": ["limb LF let go at 0.120 s", "base deviation 0.03, limit 0.01 (as asked)"] if told else [],
    }  # fmt: skip
    level = AtOneStep(5e-4, -0.1) if told else None
    compared = TuneComparison(walks, over, hardware, own, rows, broken, worth, "the verdict", level)
    contents = tune.contents(found, compared, "case.yaml")
    kept = {name: each for name, each in contents.files.items() if name not in ("walks", "margins")}
    same(f"tune_{told}", contents._replace(files=kept))


def test_gains_that_differ_within_translations_and_rotations_stand_at_their_geometric_means():
    gains = mc.Gains(1.0, 50.0, np.array([1e3, 2e3, 4e3, 10.0, 20.0, 40.0]))
    over = grid_of()
    over = over.assign(objective=over["force_variation"] / 100, feasible=over["detached_limb"] < 0)
    marks = tune._points_of_map(dataclasses.replace(found_by(), gains=gains), over, metrics_of(10.0))["marks"]
    control = CASE.control
    expected = {
        "tuned, translations": [2e3, 50.0], "tuned, rotations": [20.0, 50.0],
        "config": [control.stiffness, control.damping],
    }  # fmt: skip
    assert {each["name"]: each["at"] for each in marks} == {name: pytest.approx(at) for name, at in expected.items()}


def test_gains_stand_axis_by_axis_where_one_differs_from_axis_to_axis():
    """An integral term stands where some have one, the others where all have them."""
    six = np.array([1.0, 2.0, 3.0, 40.0, 50.0, 60.0])
    rows = {
        "tuned": ({"damping": 7.0, "stiffness": six, "kp": 3.0, "kd": 0.1}, {}), "pd": (None, {}),
        "config": ({"damping": np.full(6, 8.0), "stiffness": 9.0, "kp": 5.0, "kd": 0.2, "ki": 1.0}, {}),
    }  # fmt: skip
    told = comparison.gains_table(rows)
    axes = zip(("x", "y", "z", "rx", "ry", "rz"), ["N/m"] * 3 + ["N m/rad"] * 3, "1 2 3 40 50 60".split(), strict=True)
    assert told.columns == ["gain", "unit", "tuned", "config"]
    assert told.sections == [
        ("", [[f"stiffness {axis}", unit, value, "9"] for axis, unit, value in axes]),
        ("", [["damping", "N s/m", "7", "8"]]),
        ("", [["kp", "N m/rad", "3", "5"], ["kd", "N m s/rad", "0.1", "0.2"], ["ki", "N m/(rad s)", "-", "1"]]),
    ]


def test_a_share_of_no_lost_walks_has_no_per_cent_of_its_own():
    told = laws.laws_table(table_of(["retuned_pd", "mine", "other"], [], "retuned_pd"))
    *_, (_, rows) = told.sections
    assert [row[:4] for row in rows] == [
        ["share lost", "retuned_pd", "0", ""], ["", "mine", "0.2", "+20.0 [-380.0, 420.0]~"],
        ["", "other", "0.4", "+40.0 [-360.0, 440.0]~"],
    ]  # fmt: skip
    *_, (_, rows) = laws.laws_table(table_of(["mine", "retuned_pd"], [], "retuned_pd")).sections
    assert rows[0][:4] == ["share lost", "mine", "0", "-100.0 [-2100.0, 1900.0]~"]


def test_maps_are_drawn_while_pd_is_retuned(monkeypatch):
    """With the rows that are known then."""
    told, grid = [], grid_of()[["force_variation", "travel", "diverged", "detached_limb", "detached_at", "stands_at"]]
    rows = {"best": ({"stiffness": 100.0, "damping": 10.0}, metrics_of(20.0)), "pd": (None, metrics_of(10.0))}

    @contextlib.contextmanager
    def stage(name, **how):
        told.append((name, how))
        yield

    def compare(found, stage, *, begun, draw):
        return found, begun, draw(grid, rows)

    monkeypatch.setattr(sweep.of_sweep, "compare", compare)
    monkeypatch.setattr(sweep, "render_ahead", lambda figure, kind: told.append((figure, kind)))
    found, begun, drawn = sweep.compare("found", stage, None, "begun")
    assert (found, begun) == ("found", "begun") and told == [("maps", {"compiles": False}), (drawn.figure, "png")]
    assert sweep.sheet(grid, rows, drawn) is drawn.figure and drawn.marked[0] == {"best": (100.0, 10.0)}
    known = {name: value for name, value in metrics_of(10.0).items() if name not in (*TORN, "stands_at")}
    assert drawn.marked[1] == known


def test_the_way_of_a_search_that_told_axes_apart():
    """Translations and rotations go their own ways, and the result has a mark on each axis; crowds show their best."""
    names = ["stiffness.translation", "stiffness.rotation", "damping.x", "damping.y", "damping.z", "damping.rotation"]
    gains = mc.Gains(1.0, np.array([50.0, 60, 70, 5, 6, 7]), np.array([2e3] * 3 + [20.0] * 3))
    found = dataclasses.replace(found_by(names=names), gains=gains)
    grid = grid_of()
    about = {"units": "1", "long_name": "objective, 1 for pd"}
    grid = grid.assign(objective=(grid["force_variation"] / 100).assign_attrs(about), feasible=grid["diverged"] == 0)
    lines = approved.of_figure(tune.plot_path(found, grid))
    crowd = np.zeros(150, int)
    many = found_by(
        names=names, value=1 + 0.01 * np.arange(152), penalty=np.where(np.arange(152) < 40, 1.0, 0.0),
        feasible=[True] * 152, env_steps=np.arange(152), gradient_norm=[np.nan] * 152, round=[*crowd, 1, 1],
        row=[*crowd, 0, 1], phase=["population"] * 152,
    )  # fmt: skip
    found = dataclasses.replace(many, gains=gains)
    lines += approved.of_figure(tune.plot_path(found, grid))
    approved.check(HERE / "tune_path.txt", "\n".join([*lines, ""]))


@pytest.mark.parametrize("told", [True, False])
def test_the_folder_of_a_ceiling(told):
    how = {"unseen": {"blind": 0.9, "mine": 0.75, "pd": 1.0}, "front": True, "broken": ("mine",)} if told else {}
    found = bounded(**how)
    found.data.attrs |= {"reads_forces": "mine"} if told else {"hidden": 1, "own_gait": "mine"}
    same(f"ceiling_{told}", ceiling.contents(found, None, "case.yaml"))
