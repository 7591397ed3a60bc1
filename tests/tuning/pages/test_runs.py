"""The register of results: when, what, which settings differ, and what came of each."""

import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

import mjx_climb as mc
from tuning.command_line.session import Session
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


def test_settings_are_shown_as_they_were_written(tmp_path):
    """Truth values are no numbers, and whole numbers have any length."""
    for when, value in enumerate((True, [0.25, False], 2e4, 10**400, None, "a" * 40, "b" * 41)):
        left(tmp_path / str(when), "tune", when, search={"asked": value})
    shown = [run.differs.removeprefix("search.asked ") for run in runs.below(tmp_path)][::-1]
    assert shown[:3] + shown[4:] == ["True", "0.25 False", "20000", "None", "a" * 40, "b" * 37 + "..."]
    assert shown[3] == "1" + "0" * 36 + "..."


def test_settings_of_many_levels_differ_by_their_last(tmp_path):
    """Results of one instant stand by their names, the last first."""
    for name in ("a", "b", "c"):
        asked = {"value": name, "both": 1}
        for level in range(20):
            asked = {f"k{level}": asked}
        left(tmp_path / name, "tune", 1000, search=asked)
    before = ".".join(["search", *(f"k{level}" for level in reversed(range(20))), "value"])
    assert [(run.name, run.differs) for run in runs.below(tmp_path)] == [(n, f"{before} {n}") for n in "cba"]


HELD = {"force_variation": 47.091, "detached_limb": None, "detached_at": None, "diverged": False, "stands_at": None}
TORN = {"detached_limb": "LF", "detached_at": 3.25}


@pytest.mark.parametrize(("file", "found", "said"), [
    ("metrics", HELD, "held all the way: force variation 47.09 N"),
    ("metrics", HELD | TORN, "limb LF let go at 3.25 s: force variation 47.09 N"),
    ("metrics", HELD | {"stands_at": 0.5}, "stands from 0.5 s for want of a grip: force variation 47.09 N"),
    ("metrics", HELD | TORN | {"diverged": True}, "diverged: force variation 47.09 N"),
    ("metrics", HELD | {"force_variation": None, "diverged": True}, "diverged"),
    ("metrics", {"detached_limb": "LF"}, ""),
    ("margins", {"warnings": ["one", "another"]}, "one; another"),
    ("margins", {"warnings": []}, ""),
])  # fmt: skip
def test_the_verdict_of_a_walk_and_of_margins(tmp_path, file, found, said):
    (tmp_path / f"{file}.json").write_text(json.dumps(found))
    assert runs.verdict(tmp_path) == said
    left(tmp_path / "page", "run", 0, report="The page's.")
    assert runs.verdict(tmp_path / "page") == "The page's."


def test_a_result_without_a_record_is_known_by_its_file(tmp_path):
    (tmp_path / "sweep.nc").write_text("")
    (tmp_path / "settings.json").write_text("{")
    (run,) = runs.below(tmp_path)
    assert (run.name, run.command, run.differs, run.said) == (".", "sweep.nc", "", "settings.json is damaged")
    (tmp_path / "report.html").write_text('<p class="verdict">What came of it.</p>')
    assert runs.below(tmp_path)[0].said == "What came of it."


DEEP = "[" * 900 + "]" * 900
DAMAGED = {
    "a list": ("settings.json", '{"settings": [1], "files": [], "whole": true}'),
    "text": ("settings.json", '{"settings": "tune", "files": [], "whole": true}'),
    "deep": ("settings.json", f'{{"settings": {{"a": {DEEP}}}, "files": []}}'),
    "long": ("settings.json", f'{{"settings": {{"a": 1{"0" * 400}}}, "files": []}}'),
    "half": ("settings.json", '{"settings": {"a": "\\ud800"'),
    "half a letter": ("settings.json", '{"settings": {"a": "\\ud800"}, "files": []}'),
    "lists": ("metrics.json", f'{{"force_variation": [1], "detached_limb": [2], "detached_at": 1{"0" * 400}}}'),
    "a number": ("margins.json", '{"warnings": 3}'),
    "other text": ("report.html", "\udcff"),
}


@pytest.mark.parametrize("named", DAMAGED)
def test_a_damaged_file_hides_no_other_result(call, results, named):
    file, text = DAMAGED[named]
    left(results / "damaged", "tune", 2500)
    (results / "damaged" / file).write_text(text, errors="surrogateescape")
    code, out, err = call("runs", results, "--out", results / "page")
    assert code == 0, err
    assert all(name in out for name in ("a/again", "a/tuned", "walk", "damaged"))
    said = {run.name: run.said for run in runs.below(results)}
    assert ("settings.json is damaged" in said["damaged"]) is (named in ("a list", "text", "deep", "half"))


def test_times_of_no_calendar_and_results_that_vanish_hide_no_other(results):
    left(results / "late", "run", 2**62)
    (results / "gone").mkdir()
    (results / "gone" / "settings.json").symlink_to(results / "nowhere")
    assert {run.name for run in runs.below(results)} == {"a/again", "walk", "a/tuned", "late"}


@pytest.mark.parametrize("name", ["settings.json", "report.html", "metrics.json"])
def test_a_pipe_among_the_files_is_not_waited_for(results, name):
    left(results / "piped", "run", 2500)
    (results / "piped" / name).unlink(missing_ok=True)
    os.mkfifo(results / "piped" / name)
    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(runs.below, results)
        try:
            assert len(found.result(timeout=20)) == 4
        finally:
            if not found.done():
                os.close(os.open(results / "piped" / name, os.O_WRONLY))


def test_a_page_of_many_beginnings_is_read_in_one_pass(results):
    """4 MB: the time of a search that begins anew at each of them grows with its square, to minutes."""
    (results / "a" / "tuned" / "report.html").write_text('<p class="verdict">' * 200_000)
    assert len(runs.below(results)) == 3


def test_a_list_of_many_folders_ends_where_it_is_asked_to(results):
    def asked():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runs.below(results, asked)


def test_the_page_links_to_the_pages_of_the_results(results):
    left(results / "odd #1?", "run", 1, report="odd")
    page = runs.write(runs.below(results), results, results / "page").read_text()
    assert '<a href="../a/tuned/report.html">a/tuned</a>' in page and "pd&#39;s 1" in page
    assert '<a href="../odd%20%231%3F/report.html">odd #1?</a>' in page and page.count("report.html") == 2


def test_the_command_lists_prints_json_and_refuses_in_one_line(call, results, tmp_path):
    code, out, _ = call("runs", results, "--json", "--out", tmp_path / "p")
    assert code == 0 and (tmp_path / "p" / "runs.html").is_file()
    first = json.loads(out)[0]
    assert first["settings"] == {"scenario.control.stiffness": 5e4, "search.seed": 7} and not first["whole"]
    (tmp_path / "empty").mkdir()
    for folder in ("empty", "none"):
        code, out, err = call("runs", tmp_path / folder)
        assert (code, out) == (2, "") and err.count("\n") == 1 and str(tmp_path / folder) in err


EVIL = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202eback\r"


def test_no_name_setting_or_verdict_controls_the_terminal(call, tmp_path):
    left(tmp_path / f"a{EVIL}", "run", 2000, report=f"Found {EVIL}", law=EVIL)
    left(tmp_path / "b", "run", 1000, law="pd")
    code, out, err = call("runs", tmp_path)
    shown = out.replace("\n", "")
    assert code == 0 and "b" in out and shown.isprintable() and err.isprintable()


def test_no_line_beside_the_results_controls_the_terminal(capsys):
    shell = Session(sys.stdout)
    with shell.stage(f"search {EVIL}", compiles=False) as show:
        show(1, 2, f"best {EVIL}\nsecond line")
    shell.say(f"laws: {EVIL}")
    shell.show(f"outcome {EVIL}")
    lines = [*capsys.readouterr().err.splitlines()]
    assert len(lines) == 4 and all(line.isprintable() for line in lines)
