"""What pages show as output is what their commands print; and the runner that says so sees what is not."""

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests import pages

DOCS = Path(__file__).parents[2] / "docs"
START, IMAGES = DOCS / "start", DOCS / "images"
TUTORIAL = START / "tutorial.md"
PRINTED = [
    " metric  unit   tuned  vs pd %    pd ",
    " ─────────────────────────────────── ",
    " damping N s/m  94.55     -0.7    - ",
    " travel  m        0.1     +0.2    - ",
    "",
    "margin: holds up to 5.57 ms",
]
SHOWN = "\n".join(PRINTED[place] for place in (0, 2, 5))


def check(page, folder, wanted=lambda _: True):
    """What a page shows was printed; return how many outputs."""
    text, count = page.read_text("utf-8"), 0
    for example, printed in pages.carried_out(text, folder, wanted):
        if example.shown is not None:
            count += 1
            differs = pages.difference(example.shown, printed, pages.tolerance(text))
            assert not differs, (example.commands[-1], differs)
    return count


def test_lines_may_be_left_out_and_wrapped_and_nothing_else():
    assert pages.difference(SHOWN, PRINTED, 0.0) == ""
    assert pages.difference(SHOWN.replace("margin: holds", "margin:\nholds"), PRINTED, 0.0) == ""
    assert pages.difference(SHOWN.replace("holds", "bears"), PRINTED, 0.15).startswith("margin: bears")
    swapped = "\n".join(PRINTED[place] for place in (5, 2))
    assert pages.difference(swapped, PRINTED, 0.15).startswith("damping")


@pytest.mark.parametrize(
    ("stale", "share", "told"),
    [
        (("94.55", "94.56"), 0.0, "'94.56' for '94.55'"),
        (("94.55", "99"), 0.05, ""),
        (("94.55", "100"), 0.05, "'100' for '94.55'"),
        (("-0.7", "+4.2"), 0.05, ""),  # points
        (("-0.7", "+4.4"), 0.05, "'+4.4' for '-0.7'"),
    ],
)
def test_numbers_differ_by_no_more_than_the_page_says(stale, share, told):
    found = pages.difference(SHOWN.replace(*stale), PRINTED, share)
    assert found.startswith(told) and bool(found) == bool(told)


def test_the_tolerance_is_that_of_the_page():
    assert pages.tolerance("so numbers may differ by\nup to 15 %, and") == 0.15
    assert pages.tolerance("they differ by up to a tenth") == 0.0


def test_a_page_is_rewritten_by_what_was_printed():
    """The same lines, with the numbers of today; a long one is wrapped."""
    stale = SHOWN.replace("94.55", "94.4").replace("5.57", "5.76")
    assert pages.rewritten(stale, PRINTED) == "\n".join(line.rstrip() for line in SHOWN.splitlines()) + "\n"
    long = "the force sensor pays: " + "12.5 % less force variation, " * 5
    text = pages.rewritten("the force sensor pays: 11 % less\nforce variation", [long])
    assert max(map(len, text.splitlines())) <= pages.WIDTH and pages.difference(text, [long], 0.0) == ""
    comment = pages.rewritten("# the force", [f"# {long}"])
    assert comment.count("\n# ") == comment.count("\n") - 1 > 0 and pages.difference(comment, [f"# {long}"], 0.0) == ""


def test_an_output_belongs_to_the_command_before_it():
    page = "```sh\nmjx-climb run a\nmjx-climb export b --out c.yaml\n```\n\n```yaml\nkey: 1\n```\n"
    (example,) = pages.examples(page + "```text\nno output\n```\n")
    assert (example.shown, example.of_file) == ("key: 1\n", True)
    assert [call[0] for call in example.commands] == ["run", "export"]
    (example,) = pages.examples("```sh\nmjx-climb run a\n```\n```sh\nmake sweep\n```\n```text\nno output\n```\n")
    assert example.shown is None


@pytest.mark.slow
def test_a_walk_of_the_tutorial_prints_what_it_shows(tmp_path):
    assert check(TUTORIAL, tmp_path, lambda call: call[:2] == ["run", "hubrobo_v3_2_rock"]) == 1


@pytest.mark.slow
@pytest.mark.nightly
def test_the_first_pages_print_what_they_show(tmp_path):
    """All of their commands, in one folder, as they stand there: the searches take some minutes each."""
    outputs = [check(START / f"{page}.md", tmp_path) for page in ("first_sweep", "tutorial", "to_the_robot")]
    assert outputs == [1, 5, 4]
    check_the_pictures(tmp_path / "results", tmp_path)


def check_the_pictures(results, folder):
    """The pages' pictures are those that their commands draw: coarse pixels, whatever the fonts and the processor."""
    pytest.importorskip("selenium", reason="needs selenium")
    if None in map(shutil.which, ("chromium", "chromedriver")):
        return
    runpy.run_path(str(IMAGES / "first_pages.py"))["main"](str(results), str(folder))
    for name in ("report.webp", "report_dark.webp", "tuned_path.png", "tuned_walk.webp"):
        kept, drawn = (Image.open(path / name).convert("L") for path in (IMAGES, folder))
        assert kept.height / kept.width == pytest.approx(drawn.height / drawn.width, rel=0.03), name
        coarse = [np.asarray(picture.resize((11, 24)), float) for picture in (kept, drawn)]
        assert np.abs(coarse[0] - coarse[1]).mean() < 4, name  # of 255
