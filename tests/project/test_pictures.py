"""The drawings of the pages: their scripts draw them from the tables and contracts of today."""

import importlib
import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
DRAWN = sorted(IMAGES.glob("*.svg"))
FILMS = ("climbs.webp", "climbs_others.webp", "plans.webp", "walks.webp")  # move
LARGEST = 60_000  # bytes


@pytest.fixture
def pictures(monkeypatch):
    """The function that draws each."""
    monkeypatch.syspath_prepend(IMAGES)
    modules = map(importlib.import_module, ("studies", "drawings"))
    return {name: draw for module in modules for name, draw in module.PICTURES.items()}


def test_each_drawing_has_its_script_and_is_shown(pictures):
    assert sorted(pictures) == [path.stem for path in DRAWN]
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    shown = set(re.findall(r"!\[[^\]]+\]\([\w./]*images/([\w.]+)\)", text))
    files = {path.name for path in IMAGES.iterdir() if path.suffix in (".svg", ".png", ".webp")}
    dark = {name for name in files if "_dark." in name}
    assert shown == files - dark and {name.replace("_dark.", ".") for name in dark} <= shown


def test_pictures_are_small():
    files = [path for path in IMAGES.iterdir() if path.is_file() and path.name not in FILMS]
    assert [path.name for path in files if path.stat().st_size > LARGEST] == []


def test_every_colour_has_one_on_dark_pages(monkeypatch):
    pytest.importorskip("mkdocs", reason="needs the extra docs")
    monkeypatch.syspath_prepend(ROOT / "docs" / "hooks")
    dark = importlib.import_module("dark")
    drawings = [path.read_text("utf-8") for path in DRAWN]
    colours = {colour for text in drawings for colour in re.findall(r"#[0-9a-f]{6}\b", text)}
    assert colours == set(dark.DARK)
    assert not any(colour in dark.darkened(text) for text in drawings for colour in dark.DARK)


@pytest.mark.slow
def test_every_picture_is_drawn(pictures):
    style = importlib.import_module("studies").STYLE
    with mpl.rc_context(style):
        for name, draw in pictures.items():
            canvas = FigureCanvasAgg(draw())
            canvas.draw()
            brightness = np.asarray(canvas.buffer_rgba())[..., :3].mean(-1)
            assert 0.005 < np.mean(brightness < 200) < 0.5, name  # ink, and room around it
