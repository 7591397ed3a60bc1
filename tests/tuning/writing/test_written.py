"""The folder of a result: what it holds is said, another command's result stays; from Python as at the shell."""

import contextlib
import json
import re
import types

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
import tuning
from mjx_climb.files.dataset import OutputError
from tests.shell import ROOT
from tuning.comparisons import margins, of_search, side_by_side, verification
from tuning.comparisons import worth as worths
from tuning.gains import gains_file
from tuning.kinds import write_found
from tuning.methods.parts import Parts
from tuning.pages.contents import Contents, Picture, Written, files_of
from tuning.pages.page import Findings, Origin, Page
from tuning.pages.section import Section
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.results import tuned
from tuning.results.config_file import write_config
from tuning.searches import retuned_pd
from tuning.searches.tune import tune
from tuning.writing import folder as folders
from tuning.writing.record import check_own

SHORT = {"duration": 0.3, "disturbance.cargo.start": 0.1}


def test_a_report_names_the_function_that_gives_its_result():
    """`tuning.judge` stood on the pages of `evaluate`, under its last name."""
    public = re.findall(r"`(?:tuning\.)?(\w+)`", tuning.__doc__)
    texts = [file.read_text() for file in (ROOT / "tuning" / "results").glob("*.py")]
    kinds = {kind for text in texts for kind in re.findall(r'^    KIND = "(\w+)"$', text, re.MULTILINE)}
    assert len(kinds) == 9 and kinds <= set(public)


def test_each_kind_of_result_has_its_page():
    """`tuning.write` finds a page by the line in which it names the result."""
    results, pages = (
        "".join(file.read_text() for file in sorted((ROOT / "tuning" / room).glob("*.py")))
        for room in ("results", "pages")
    )
    classes = re.findall(r"^class (\w+)\(\w+\):\n(?:(?!class ).*\n)*?    KIND = ", results, re.MULTILINE)
    assert sorted(classes) == sorted(re.findall(r"^def contents\(found: (\w+), ", pages, re.MULTILINE))


@pytest.mark.nightly
@pytest.mark.slow
def test_a_search_writes_its_folder_from_python(tmp_path, capsys):
    """Every file of the command, the user's objective in the tests, stages told, nothing printed."""
    stages = []

    @contextlib.contextmanager
    def stage(name, **_):
        stages.append(name)
        yield lambda *_: None

    def judge(metrics):
        return metrics["peak_joint_torque"]

    scenario = mc.load_scenario("case_1_2").with_overrides(SHORT)
    found = tune(scenario, objective=judge, starts=2, iterations=2, out=tmp_path)
    written = tuning.write(found, tmp_path, stage=stage)
    names = {file.name for file in tmp_path.iterdir()}
    pictures = {f"{name}.png" for name in ("convergence", "path", "walks", "margins")}
    files = {"report.html", "gains.yaml", "search.nc", "map.nc", "summary.json", "config.yaml", "search.yaml"}
    assert names == files | pictures | {"settings.json"}
    walked = ["pd", "config", "tuned", "retuned_pd", "planned_unsearched"]
    assert stages == ["retuned pd", *walked, "map", "margins", "verification", "drawing", "report"]
    summary = json.loads(written.summary)
    torques = [summary[name]["metrics"]["peak_joint_torque"] for name in ("tuned", "retuned_pd")]
    assert summary["force_sensor"]["objective"] == pytest.approx(torques[0] / torques[1] - 1)
    assert set(summary["verification"]["margins"]) == set(margins.QUANTITIES)
    assert sum(line.startswith("margin, ") for line in written.outcome) == len(margins.QUANTITIES)
    assert names == {*written.files.split(", "), "settings.json"}
    assert summary["force_sensor"]["in_words"] in written.outcome
    assert list(summary["retuned_pd"]["gains"]) == ["kp", "kd"] and list(written.compared) == [
        "tuned", "retuned_pd", "config", "pd"
    ]  # fmt: skip
    assert json.loads((tmp_path / "summary.json").read_text()) == json.loads(written.summary)
    assert summary["verification"]["value"] == pytest.approx(torques[0])
    assert tuned.load(tmp_path / "search.nc").value == found.value
    assert gains_file.load(tmp_path / "gains.yaml").stiffness == pytest.approx(found.gains.stiffness)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("method", "more"), [("gradient", 0), ("cmaes", 1)])
def test_a_search_without_gradients_has_the_program_of_the_tests_loaded_beside(monkeypatch, method, more):
    asked = []
    monkeypatch.setattr(verification, "slopes_at", lambda problem, theta: asked.append(theta.shape))
    scenario = mc.load_scenario("case_1_2").with_overrides(SHORT)
    problem = types.SimpleNamespace(scenario=scenario)
    monkeypatch.setattr(of_search, "start_of", lambda problem: np.zeros(2))
    works = []
    of_search.load_tests(problem, Search(method=method), works.append)
    for work in works:
        work(lambda *_: None)
    assert asked == [(2,)] * more


@pytest.mark.parametrize(
    ("step", "told", "others"),
    [(1e-3, (1e-3, 5e-4, (5e-4, 0.0)), ["config"]), (2.5e-4, (2.5e-4, 2.5e-4, None), ["config", margins.RETUNED])],
)
def test_a_law_is_compared_with_pd_at_its_own_time_step_and_at_that_of_pd(step, told, others, monkeypatch):
    """Without walking: the arguments of the verdict on the force sensor. Worse hardware has walks of one step alone."""

    class Given(Exception):
        pass

    def worth(ours, theirs, _, *, level, **__):
        raise Given(ours["objective"], theirs["objective"], level)

    nothing, joint, asked = (lambda *_, **__: None), {"kp": 17.0, "kd": 1.0}, []
    scenario = mc.load_scenario("case_1_2").with_overrides({"time_step": step})
    for module, name, value in (
        (verification, "tests", nothing), (verification, "broken_limits", lambda *_: []),
        (verification, "verify", lambda *_, **__: types.SimpleNamespace(warnings=[])),
        (margins, "find", lambda *_, others, **__: asked.extend(others)), (worths, "differences", nothing),
        (of_search, "with_joint_gains", nothing),
        (of_search, "scores_of", lambda _, metrics: {"objective": metrics}), (retuned_pd, "joint_of", lambda _: joint),
        (retuned_pd, "rival_of", lambda *_: retuned_pd.Rival(joint, 0.5)), (worths, "worth_of", worth),
        (mc, "rollout", lambda walked, **_: walked), (mc, "metrics", lambda walked, _: walked.time_step),
        (side_by_side, "walk_of_any", lambda walked, *_, **__: walked),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)
    own = Problem(scenario)
    found = types.SimpleNamespace(scenario=scenario, problem=own, walked=own, law=None, gains=None, ends=[0.5])
    begun = of_search.Begun(lambda _: types.SimpleNamespace(feasible=True, ends=[0.6]), None, {}, nothing, {})
    with pytest.raises(Given) as given:
        of_search.compare(found, begun=begun)
    assert given.value.args == told and asked == others


def found_in(scenario):
    """Return a result of two points, the second of which is the better one."""
    columns = {"value": [0.9, 0.8], "penalty": [0.0, 0.0], "feasible": [True, True], "env_steps": [10, 20]}
    columns["phase"] = ["population", "population"]
    data = xr.Dataset({name: ("point", values) for name, values in columns.items()})
    data["theta"] = (("point", "coordinate"), np.log([[1e2, 1e3], [2e2, 2e3]]))
    attrs = {"search": Search(seed=3).to_yaml(), "interrupted": 0, "scenario": scenario.to_yaml()}
    attrs["gains"] = '{"inertia": 1.0, "damping": 200.0, "stiffness": 2000.0}'
    return tuned.Tuned(data.assign_attrs(attrs), Problem(scenario), Search(seed=3), gains=mc.Gains(1.0, 2e2, 2e3))


def test_a_folder_names_what_it_holds_and_a_result_comes_back(monkeypatch, tmp_path):
    called = []

    def contents(found, compared, name):
        called.append(name)
        return Contents(Written(outcome=["said"]), found.problem, files_of(found, name) | {"more.txt": compared})

    asked, stage = [], contextlib.nullcontext
    monkeypatch.setattr("tuning.pages.tune.compare", lambda *given: asked.append(given) or "more")
    monkeypatch.setattr("tuning.pages.tune.contents", contents)
    found = found_in(mc.load_scenario("case_1_2"))
    Parts(tmp_path, {"a": 1}).save(0, {"x": np.arange(2)})
    answers, settings = [], {"command": "tune"}
    written = tuning.write(found, tmp_path, stage=stage, begun="begun", answer=answers.append, settings=settings)
    assert asked == [(found, stage, tmp_path, "begun")] and [each.outcome for each in answers] == [["said"]]
    assert json.loads((tmp_path / "settings.json").read_text())["settings"] == settings
    tuning.write(found, tmp_path, stage=stage, origin=Origin("mine.yaml", "asked", "again"), settings=settings)
    assert called == ["from Python", "mine.yaml"]
    assert "mjx-climb tune mine.yaml: " in (tmp_path / "gains.yaml").read_text()
    names = {*written.files.split(", "), "settings.json"}
    assert names == {file.name for file in tmp_path.iterdir()} > {"more.txt"}
    read = tuned.load(tmp_path / "search.nc")
    for name in ("scenario", "search", "value", "best_at", "env_steps", "feasible", "interrupted"):
        assert getattr(read, name) == getattr(found, name), name
    assert (read.value, read.best_at, read.env_steps) == (0.8, 20, 20)
    np.testing.assert_array_equal(read.theta, np.log([2e2, 2e3]))
    assert read.gains.stiffness == gains_file.load(tmp_path / "gains.yaml").stiffness == 2e3
    assert "objective 0.8000 (pd: 1)" in (tmp_path / "gains.yaml").read_text()
    with pytest.raises(OutputError, match=r"expected a folder without another command's result, got search\.nc in it"):
        check_own(tmp_path, "sweep.nc")
    with pytest.raises(OutputError, match=r"got search\.nc in it"):
        tuning.write(types.SimpleNamespace(FILE="sweep.nc"), tmp_path, begun="begun")


def least_force(metrics):
    """An objective of one's own."""
    return metrics["peak_foot_force"]


def guesses(problem):
    """A method of one's own."""


def test_the_config_of_a_folder_names_each_object_of_ones_own(tmp_path):
    """The scenario of the walks keeps the method alone, which no walk reads."""
    case, law = mc.load_scenario("case_1_2"), mc.control.LoadTransfer()
    returned = write_config(case, tmp_path, law, mc.METRICS, least_force, types.SimpleNamespace(function=guesses))
    own = mc.load_scenario(tmp_path / "config.yaml").own
    assert (own.law.name, own.objective.name, own.method.name, own.metrics) == (
        "LoadTransfer", "least_force", "guesses", ()
    )  # fmt: skip
    assert (returned.own.law, returned.own.objective, returned.own.method.name) == (None, None, "guesses")
    assert write_config(case, tmp_path) == case and mc.load_scenario(tmp_path / "config.yaml").own is None


@pytest.mark.parametrize("again", ["", "mjx-climb again"])
def test_a_page_knows_the_call_the_files_and_what_repeats_them(again, tmp_path):
    """Pictures stand on it as PNG whatever the formats; those of a section stand there alone."""
    asked, problem = [], Problem(mc.load_scenario("case_1_2", {"control.kp": 41.0}))

    def page(origin):
        asked.append(origin)
        return Page("", Findings("verdict"), problem.scenario)

    def files(copied, place, call):
        asked.append((copied.control.kp, (place / "config.yaml").is_file(), call))
        return {"a.txt": "text", "drawn": Picture("A picture.", Figure)}

    section = Section("Mine", pictures={"mine": Picture("Mine.", Figure)})
    made = Contents(Written(outcome=["said"]), problem, files, page, again)
    told = folders.write(made, tmp_path, "tuning.tune(...)", figures=["svg"], sections=[section])
    copied, origin = asked
    assert copied == (41.0, True, "tuning.tune(...)") and [*origin.pictures] == ["A picture."]
    assert (origin.name, origin.asked, origin.again) == (
        "the scenario",
        "tuning.tune(...)",
        again or "tuning.tune(...)",
    )
    assert "kp: 41.0" in origin.config and told.outcome == ["said"]
    assert told.files == "report.html, a.txt, drawn.png, drawn.svg, mine.png, mine.svg, config.yaml"
    asked.clear()
    told = folders.write(made._replace(page=None, files={"drawn": Picture("", Figure)}), tmp_path, "", figures=["svg"])
    assert told.files == "drawn.svg, config.yaml" and not asked


def test_an_interrupted_result_keeps_its_parts(tmp_path):
    Parts(tmp_path, {"a": 1}).save(0, {"x": np.arange(2)})
    write_found(found_in(mc.load_scenario("case_1_2")), tmp_path)
    assert Parts(tmp_path, {"a": 1}).load(0) is not None and (tmp_path / "gains.yaml").is_file()
