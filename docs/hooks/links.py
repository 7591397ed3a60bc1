"""Links that lead out of docs/ in the repository, led to the page of the site that stands for the file."""

import posixpath
import re

LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")


def on_page_markdown(markdown: str, page, **_) -> str:
    """Turn the relative links of a page."""
    here = posixpath.dirname(page.file.src_uri)
    # pages made from files outside of docs/ keep the folders of these
    folder = here if page.file.generated_by else posixpath.join("docs", here)

    def turned(found: re.Match) -> str:
        path = posixpath.normpath(posixpath.join(folder, found[1]))
        return posixpath.relpath(_on_site(path), here or ".")

    return LINK.sub(turned, markdown)


def _on_site(path: str) -> str:
    """Return where a file of the repository, by its path from the top, is on the site."""
    if path == "README.md":
        return "index.md"
    if path.endswith(".ipynb"):
        return f"{path.removesuffix('.ipynb')}.md"
    return path.removeprefix("docs/")
