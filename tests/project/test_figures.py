"""Figures of README and the studies' pages are those of their tables."""

import importlib.util
from pathlib import Path

STUDIES = Path(__file__).parents[2] / "docs" / "studies"


def program(name):
    spec = importlib.util.spec_from_file_location(name, STUDIES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pages_say_what_their_tables_have():
    """`python docs/studies/figures.py` prints what a page lacks."""
    figures = program("figures")
    pieces = figures.texts()
    assert len(pieces) == 10 and sum(map(len, pieces.values())) > 135
    assert [(page.name, piece) for page, piece in figures.lacking()] == []


def test_shipped_gains_are_the_best_that_are_known():
    """`python docs/studies/shipped_gains.py configs/gains` writes them."""
    files = program("shipped_gains").files()
    assert len(files) == 1
    for name, text in files.items():
        assert (STUDIES.parents[1] / "configs" / "gains" / name).read_text() == text, name
