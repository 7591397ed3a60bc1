"""The register of results: when, what, which settings differ, and what came of each."""

import json
import os

import pytest

import mjx_climb as mc
from tuning.pages import runs

CASE = mc.Scenario().model_dump(mode="json")


def left(folder, command, when, *, scenario=CASE, whole=True, report="", **asked):
    """Leave what a command leaves in its folder."""
    folder.mkdir(parents=True)
    record = {"settings": {"command": command, "scenario": scenario, **asked}, "files": [], "whole": whole}
    (folder / "settings.json").write_text(json.dumps(record))
    os.utime(folder / "settings.json", (when, when))
    if report:
        (folder / "report.html").write_text(
            f'<title>x</title>\n<p class="verdict">{report}</p>\n<p class="verdict">2</p>'
        )


@pytest.fixture
def results(tmp_path):
    stiff = {**CASE, "control": {**CASE["control"], "stiffness": 2e4}}
    left(tmp_path / "a" / "tuned", "tune", 1000, report="Tuned gains score 0.8 of pd&#39;s 1.", search={"seed": 0})
    left(tmp_path / "a" / "again", "tune", 3000, whole=False, search={"seed": 7})
    left(tmp_path / "walk", "run", 2000, scenario=stiff)
    (tmp_path / "walk" / "metrics.json").write_text(
        json.dumps({"force_variation": 47.091, "detached_limb": "LF", "detached_at": 3.2, "diverged": False})
    )
    (tmp_path / ".hidden").mkdir()
    (tmp_path / ".hidden" / "sweep.nc").write_text("")
    return tmp_path


def test_results_are_listed_with_the_settings_that_differ(results):
    found = runs.below(results)
    assert [(run.name, run.command, run.whole) for run in found] == [
        ("a/again", "tune", False), ("walk", "run", True), ("a/tuned", "tune", True)
    ]  # fmt: skip
    assert [run.differs for run in found] == [
        "control.stiffness 50000, search.seed 7", "control.stiffness 20000", "control.stiffness 50000, search.seed 0"
    ]  # fmt: skip
    assert [run.said for run in found] == [
        "not finished", "limb LF let go at 3.2 s: force variation 47.09 N", "Tuned gains score 0.8 of pd's 1."
    ]  # fmt: skip


def test_a_result_without_a_record_is_known_by_its_file(tmp_path):
    (tmp_path / "sweep.nc").write_text("")
    (tmp_path / "settings.json").write_text("{")
    (run,) = runs.below(tmp_path)
    assert (run.name, run.command, run.differs, run.said) == (".", "sweep.nc", "", "")


def test_the_page_links_to_the_pages_of_the_results(results):
    page = runs.write(runs.below(results), results, results / "page").read_text()
    assert '<a href="../a/tuned/report.html">a/tuned</a>' in page and "pd&#39;s 1" in page
    assert "report.html" not in page.replace("../a/tuned/report.html", "")


def test_the_command_lists_prints_json_and_refuses_in_one_line(call, results, tmp_path):
    code, out, _ = call("runs", results, "--json", "--out", tmp_path / "p")
    assert code == 0 and (tmp_path / "p" / "runs.html").is_file()
    first = json.loads(out)[0]
    assert first["settings"] == {"scenario.control.stiffness": 5e4, "search.seed": 7} and not first["whole"]
    (tmp_path / "empty").mkdir()
    for folder in ("empty", "none"):
        code, out, err = call("runs", tmp_path / folder)
        assert (code, out) == (2, "") and err.count("\n") == 1 and str(tmp_path / folder) in err
