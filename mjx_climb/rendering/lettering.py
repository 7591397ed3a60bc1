"""The letters of words on rendered pictures."""

import functools
from pathlib import Path

import matplotlib
from PIL import ImageFont


@functools.cache
def font(pixels: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return a font of a height, in pixels: the one that comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, pixels)
