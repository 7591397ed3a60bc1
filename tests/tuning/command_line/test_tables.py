"""Tables at the terminal: no number and no word of a header is broken or cut, however narrow it is."""

import io

import pytest

from tests.tuning.pages.test_ceiling import MEANS, bounded
from tuning.command_line.session import broken, console, print_on
from tuning.pages import ceiling
from tuning.pages.table import Table

METRICS = [
    "force variation", "peak foot force N", "cost of transport", "peak joint torque N m", "base deviation m",
    "my_own_metric_of_force", "unit",
]  # fmt: skip
ROWS = [["config, as it is", "0.1234", "-12.345", "1.234e-05", "0.1", "0.0123", "98765.4321", "N m/rad"]]
TABLES = {
    "ceiling": ceiling.table(bounded(unseen=dict.fromkeys(MEANS, 0.9))),
    "words": Table("", ["walk", *METRICS], [("limbs that are far: 2", ROWS), ("", ROWS)], 1),
    "names": Table("", ["walk", "metric"], [("", [["pd", "force variation"]])], 2),
    "empty": Table("", ["walk", *METRICS], [], 1),
}
RUNS = Table("", ["when", "folder", "differs in", "verdict"], [("", [[
    "2026-11-30 03:15", "replay_23-seconds-and-nanoseconds", "log:/data/2026/logs/23-seconds-and-nanoseconds/a.bag",
    "goal (retuned_pd, kp 10.67, kd 0.32) not reached",
]])], 4)  # fmt: skip


def printed(table, width):
    (screen := console(text := io.StringIO())).width = width
    print_on(screen, table)
    return text.getvalue().split("\n")


@pytest.mark.parametrize("width", [40, 80, 100, 200])
@pytest.mark.parametrize("table", [*TABLES.values(), RUNS], ids=[*TABLES, "only words"])
def test_no_word_and_no_number_is_broken_and_no_line_is_wider_than_the_terminal(table, width):
    """In a file; words alone that have no room make it wider, each column as its longest word."""
    lines = printed(table, width)
    assert max(map(len, lines)) <= max(width, 10 + 33 + 55 + 12 + 4 * 2 if table is RUNS else 0)
    words = [part for line in lines for part in line.split()]
    for place, name in enumerate(table.columns):
        assert not {*broken(name).split()} - {*words}, name
        for row in (row for _, rows in table.sections for row in rows):
            assert not {*row[place].split()} - {*words}
    assert sum("contestant" in line for line in printed(TABLES["ceiling"], width)) == {40: 4, 80: 2}.get(width, 1)


def test_columns_that_go_on_below_stand_beside_the_names_of_their_rows():
    lines = printed(TABLES["words"], 60)
    assert sum("walk" in line for line in lines) == 2
    assert sum("N m/rad" in line for line in lines) == 2 * len(ROWS) * sum("walk" in line for line in lines)


def test_a_table_that_fits_has_each_column_once_and_is_as_wide_as_it_must_be():
    table = Table("", ["metric", "unit", "pd", "goal"], [("", [["travel", "m", "0.1", "-"]])])
    lines = printed(table, 80)
    assert lines[1:4:2] == [" metric  unit   pd  goal ", " travel  m     0.1     - "]
    assert printed(table, 25) == lines and max(map(len, printed(table, 24))) == 20
