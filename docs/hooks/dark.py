"""Pictures on dark pages, of which the theme shows those of its scheme.

Each SVG has a second one in other colours. A raster picture NAME.webp has one where docs/images has NAME_dark.webp.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

# a drawing's colours on white, and those that stand for them on the theme's dark ground
DARK = {
    "#ffffff": "none",
    "#222222": "#e2e4e9",
    "#d0d0d0": "#4a4e5a",
    "#0072b2": "#56b4e9",
    "#d55e00": "#f0a040",
    "#009e73": "#40c9a2",
    "#aa4499": "#e0a0c8",
}
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s#]+)(\.\w+)\)")
IMAGES = Path(__file__).parents[1] / "images"


def darkened(drawing: str) -> str:
    """Return a drawing in the colours for dark ground."""
    return re.sub("|".join(DARK), lambda found: DARK[found[0]], drawing)


def on_files(files, config):
    """Add the dark drawings."""
    for file in [file for file in files if file.src_uri.endswith(".svg")]:
        path = f"{posixpath.splitext(file.src_uri)[0]}_dark.svg"
        files.append(File.generated(config, path, content=darkened(file.content_string)))
    return files


def on_page_markdown(markdown: str, **_) -> str:
    """Show both where a page shows one."""
    return PICTURE.sub(_both, markdown)


def _both(found: re.Match) -> str:
    text, path, suffix = found.groups()
    if suffix != ".svg" and not (IMAGES / f"{posixpath.basename(path)}_dark{suffix}").exists():
        return found[0]
    return f"![{text}]({path}{suffix}#only-light)![{text}]({path}_dark{suffix}#only-dark)"
