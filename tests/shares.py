"""Shares of the tests that run once a night, so that each is run on some day of a month before a change lands."""

from collections.abc import Iterable


def first_cases(tests: Iterable[str], place: int, count: int) -> list[str]:
    """Return the first case of each function of a share, one in `count`, by the names of all cases, "file::test[0]"."""
    first = dict[str, str]()
    for test in tests:
        first.setdefault(test.partition("[")[0], test)
    return [*first.values()][place % count :: count]
