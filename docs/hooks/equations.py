"""Equations as MathML, which browsers draw themselves: no script, no network."""

import html
import re

from latex2mathml.converter import convert

# what pymdownx.arithmatex makes of $...$ and $$...$$
INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAY = re.compile(r'<div class="arithmatex">\\\[(.*?)\\\]</div>', re.DOTALL)


def on_page_content(content: str, **_) -> str:
    """Replace the equations of a page."""
    content = DISPLAY.sub(lambda found: f'<div class="equation">{_side_by_side(found[1])}</div>', content)
    return INLINE.sub(lambda found: _mathml(found[1], "inline"), content)


def _side_by_side(tex: str) -> str:
    """Return equations that stand side by side one by one, so that a narrow window has them one below the other."""
    return "".join(_mathml(part, "block") for part in tex.split(r"\qquad"))


def _mathml(tex: str, display: str) -> str:
    return convert(html.unescape(tex).strip(), display=display)
