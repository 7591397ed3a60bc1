"""Sections of the user's own, of `docs/guides/section.md`, on the page of a result and in its folder."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
import tuning
from tuning.pages.contents import Contents, Written
from tuning.pages.page import Findings, Page
from tuning.pages.section import Picture, Section, Table, load_section, sections_of
from tuning.problem.evaluation import Problem
from tuning.results.judged import Judged

SCRIPT = Path(__file__).parents[3] / "docs" / "guides" / "load_section.py"
NUMBER = 3


def all_of(found, compared):
    """A section with something of each kind."""
    return Section(
        "Mine", ["A sentence of mine."], [Table("My table", ["a", "b"], [("", [["x", "1"]])], 1)],
        {"mine": Picture("My picture.", Figure)}, {"mine.txt": str(compared), "mine.nc": xr.Dataset({"x": 1})},
    )  # fmt: skip


def none(found, compared):
    return None


def failing(found, compared):
    return found.nothing


def wrong(found, compared):
    return "text"


def empty(found, compared):
    return ()


def same_file(found, compared):
    return Section("Mine", files={"config.yaml": "mine"})


def same_record(found, compared):
    return Section("Mine", pictures={"settings.json": Picture("", Figure)})


def same_page(found, compared):
    return Section("Mine", files={"report.html": "mine"})


def outside(found, compared):
    return Section("Mine", files={"../mine.txt": "mine"})


def without_picture(found, compared):
    return Section("Mine", pictures={"mine": Picture("", lambda: [].pop())})


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Return a function that writes a result with sections, which was compared with "walks"."""
    scenario = mc.load_scenario("case_1_2")

    def contents(found, compared, name):
        return Contents(Written(), found.problem, {}, Page("", Findings("", notes=["A note."]), scenario).at)

    monkeypatch.setattr("tuning.pages.judge.compare", lambda *_: "walks")
    monkeypatch.setattr("tuning.pages.judge.contents", contents)
    return lambda *sections: tuning.write(Judged(xr.Dataset(), Problem(scenario)), tmp_path, sections=sections)


def test_sections_of_ones_own_stand_on_the_page_and_in_the_folder(written, tmp_path):
    """By FILE.py:NAME and as functions, below all that is shipped."""
    told = written(none, f"{__file__}:all_of")
    text = (tmp_path / "report.html").read_text()
    headings = re.findall("<summary>(.*)</summary>", text)
    assert headings[:2] == ["What else was found (1)", "Mine"] and len(headings) == 4
    for words in ("<caption>My table", "<li>A sentence of mine.", "<figcaption>My picture.", "data:image/png;base64,"):
        assert words in text
    assert (tmp_path / "mine.txt").read_text() == "walks"
    names = {file.name for file in tmp_path.iterdir()}
    assert {*told.files.split(", "), "settings.json"} == names > {"mine.txt", "mine.nc", "mine.png", "report.html"}
    assert "mine.png" in json.loads((tmp_path / "settings.json").read_text())["files"]


@pytest.mark.parametrize(
    ("section", "said"),
    [
        (same_file, "section Mine: expected other files than those of the result, got config.yaml"),
        (same_record, "section Mine: expected other files than those of the result, got settings.json"),
        (same_page, "section Mine: expected other files than those of the result, got report.html"),
        (outside, "section Mine: expected files in the result's folder, got '../mine.txt'"),
        (without_picture, "section without_picture: IndexError: pop from empty list"),
    ],
)
def test_a_section_that_fails_as_it_is_written_leaves_the_folder_as_it_was(written, tmp_path, section, said):
    (tmp_path / "mine").write_text("")
    with pytest.raises(mc.ConfigError, match=f"^{re.escape(said)}$"):
        written(section)
    assert [file.name for file in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: load_section(f"{__file__}:NUMBER"), "expected NUMBER to be a function of a result and its compar"),
        (lambda: load_section(f"{__file__}:nobody"), "expected a section named nobody, got none"),
        (lambda: sections_of([failing], SimpleNamespace(), None), "section failing: AttributeError: "),
        (lambda: sections_of([wrong], None, None), "section wrong: expected a tuning.pages.section.Section or None"),
        (lambda: sections_of([empty], None, None), "section empty: expected a tuning.pages.section.Section or None"),
    ],
)
def test_what_is_no_section_is_refused_in_one_line(made, said):
    with pytest.raises(mc.ConfigError, match=re.escape(said)) as refused:
        made()
    assert "\n" not in str(refused.value)


@pytest.mark.nightly
def test_the_section_of_the_page_at_the_shell(tmp_path, call):
    config, short = tmp_path / "short.yaml", {"duration": 0.3}
    config.write_text(mc.load_scenario("case_1_2", short).to_yaml())
    grid = ["--stiffness", "1e3:1e4:2", "--damping", "1e2:1e3:2"]
    code, _, err = call("sweep", config, *grid, "--section", f"{SCRIPT}:load", "--out", tmp_path / "out")
    assert code == 0, err
    text = (tmp_path / "out" / "report.html").read_text()
    assert "<summary>Load of the feet</summary>" in text and (tmp_path / "out" / "load.png").is_file()
    code, _, err = call("sweep", config, *grid, "--section", f"{SCRIPT}:nobody", "--out", tmp_path / "other")
    assert code == 2 and err.count("\n") == 1 and not (tmp_path / "other").exists()
