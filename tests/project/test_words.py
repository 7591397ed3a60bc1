"""Plain words: pages, help, messages and docstrings use no pattern of `words.txt`, and no endless sentence."""

import ast
import json
import re
from pathlib import Path

import click
import pytest
import typer

from tests.pages import FENCE
from tuning.command_line.program import program

ROOT = Path(__file__).parents[2]
RULES = [
    re.split(r" {2,}", line.strip(), maxsplit=1)
    for line in (Path(__file__).parent / "words.txt").read_text("utf-8").splitlines()
    if line.strip() and not line.startswith("#")
]
MADE = "paper_run.md"  # a command writes it
PAGES = sorted(page for page in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")] if page.name != MADE)
PROGRAM = typer.main.get_command(program())
LONGEST = 45  # words of a sentence
MOST = 25_000  # words
# tables, headings and equations hold no sentences
NO_SENTENCE = re.compile(r"^[|#].*$|(?s:\$\$.*?\$\$)", re.MULTILINE)
END = re.compile(r"(?<=[.:;?])\s|\n\n|\n *(?:[-*]|\d+\.) ")


def found(text: str) -> list[tuple[str, str]]:
    """Return what a text has of the list, and what to write."""
    matches = [(re.search(pattern, text, re.IGNORECASE), advice) for pattern, advice in RULES]
    return [(text[max(0, match.start() - 30) : match.end() + 30], advice) for match, advice in matches if match]


def endless(text: str) -> list[str]:
    return [part for part in END.split(NO_SENTENCE.sub("\n\n", text)) if len(part.split()) > LONGEST]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_uses_plain_words(page):
    text = FENCE.sub("\n\n", page.read_text("utf-8"))
    assert found(" ".join(text.split())) == [] and endless(text) == []


@pytest.mark.parametrize("name", PROGRAM.commands)
def test_a_help_text_uses_plain_words(name):
    command = PROGRAM.commands[name]
    assert found(" ".join(command.get_help(click.Context(command, info_name=name)).split())) == []


@pytest.mark.parametrize("package", ["mjx_climb", "tuning"])
def test_messages_and_docstrings_use_plain_words(package):
    """All text in the code: help, errors, warnings, reports, docstrings."""
    wrong = []
    for file in sorted((ROOT / package).rglob("*.py")):
        nodes = ast.walk(ast.parse(file.read_text("utf-8")))
        texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
        wrong += [(file.name, *match) for text in texts if " " in text for match in found(" ".join(text.split()))]
    assert wrong == []


@pytest.mark.parametrize("path", sorted(ROOT.glob("notebooks/*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_begins_with_what_it_shows_in_plain_words(path):
    cells = [cell for cell in json.loads(path.read_text("utf-8"))["cells"] if cell["cell_type"] == "markdown"]
    texts = ["".join(cell["source"]) for cell in cells]
    assert texts[0].split("\n\n")[1].startswith("**This notebook shows**")
    assert [match for text in texts for match in found(" ".join(text.split()))] == []


def test_pages_of_users_are_short_and_begin_with_what_they_are_for():
    """Start, guides and explanation: three screens each, 25,000 words in all, code and tables among them."""
    pages = [page for kind in ("start", "guides", "explanation") for page in (ROOT / "docs" / kind).glob("*.md")]
    texts = {page: page.read_text("utf-8") for page in pages}  # names may be alike: there are two hardware.md
    assert len(pages) > 40 and sum(len(text.split()) for text in texts.values()) <= MOST
    assert [name for name, text in texts.items() if text.count("\n") > 130] == []
    assert [name for name, text in texts.items() if not text.split("\n\n")[1].startswith("After this page")] == []


def test_a_study_has_its_parts():
    parts = ("**Question.**", "**Answer.**", "\n|", "## What it rests on", "](../images/")
    for page in (ROOT / "docs" / "studies").glob("*.md"):
        text = page.read_text("utf-8")
        assert page.name == MADE or (all(part in text for part in parts) and text.count("\n") < 90), page


def test_the_list_finds_what_it_holds():
    assert found("a law of one's own") == [("a law of one's own", "your own"), ("a law of one's own", "your own")]
    assert len(RULES) > 20 and found("a law of your own") == []
    assert endless("word " * 46) and not endless("word " * 30 + "end. " + "word " * 30)
