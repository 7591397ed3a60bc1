"""Drawings on dark pages: of each SVG a second one in other colours, of which the theme shows that of its scheme."""

import posixpath
import re

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
PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s#]+)\.svg\)")


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
    return PICTURE.sub(r"![\1](\2.svg#only-light)![\1](\2_dark.svg#only-dark)", markdown)
