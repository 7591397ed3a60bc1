"""The documentation as a site, opened from disk in a real browser."""

import html
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import mjx_climb as mc
import tuning

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("material", reason="needs the extra docs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    return folder


@pytest.mark.slow
def test_the_reference_shows_every_field(site):
    """Of each record that a page shows, and of each public one, with the meaning that its declaration has."""
    for package in (tuning, mc):
        page = html.unescape((site / "reference" / f"{package.__name__}.html").read_text("utf-8"))
        parts = dict(re.findall(r'<h3 id="([\w.]+)"(.*?)(?=<h[23] |$)', page, re.DOTALL))
        shown = {
            path: getattr(importlib.import_module(path.rpartition(".")[0]), path.rpartition(".")[2]) for path in parts
        }
        public = {name: each for name in package.__all__ if isinstance(each := getattr(package, name), type)}
        assert not [name for name, kind in public.items() if kind not in shown.values()]
        for path, kind in shown.items():
            if not isinstance(kind, type):
                continue
            whole = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", parts[path])).lower()
            assert "fmt: skip" not in whole
            fields = {name: "" for name in getattr(kind, "_fields", ())}
            for name, field in getattr(kind, "__dataclass_fields__", {}).items():
                declared = field.metadata.get("value", SimpleNamespace(**field.metadata))
                fields[name] = getattr(declared, "long_name", getattr(declared, "meaning", ""))
            fields |= {name: field.description or "" for name, field in getattr(kind, "model_fields", {}).items()}
            missing = [name for name in fields if name.islower() and f">{name}</span></code></b>" not in parts[path]]
            assert not missing + [text for text in fields.values() if text.lower() not in whole], kind
    command = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", parts["mjx_climb.control.law.Command"]))
    assert "(6,) m, rad: the law's shift of the base, reference axes" in command


@pytest.mark.nightly
def test_docstrings_and_lists_are_shown_as_they_are_written(site):
    """(*batch, 3) twice is no emphasis, what is returned is one thing however many lines say what, and no item of a
    list is lost in a paragraph: Python-Markdown wants an empty line where GitHub does not."""
    for page in (site / "reference").glob("*.html"):
        article = page.read_text("utf-8").split("<article")[1].split("</article")[0]
        assert "<em>" not in article and r"\*" not in article
        assert not re.search(r"<code>[^<]*`", article)  # a sentence that was taken for a type
        assert not re.search(r"Returns:</span></p>\s*<ul>\s*<li[^>]*>(?:(?!</ul>).)*<li", article, re.DOTALL)

    for page in [*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")]:
        place = page.relative_to(ROOT / "docs" if page.is_relative_to(ROOT / "docs") else ROOT)
        built = site / ("index.html" if page.name == "README.md" else place.with_suffix(".html"))
        # docs/package.md is for the package index, and docstrings bring lists of their own
        if not built.exists() or place.parent.name == "reference":
            continue
        source = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
        items = re.findall(r"^ *(?:[-*]|\d+\.) ", source, re.MULTILINE)
        article = built.read_text("utf-8").split("<article")[1].split("</article")[0]
        assert article.count("<li>") == len(items), page


def resize(chromium, width):
    chromium.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    )


@pytest.mark.nightly
def test_the_search_works_from_disk(site, chromium):
    from selenium.webdriver.support.wait import WebDriverWait

    resize(chromium, 1300)
    chromium.get((site / "start" / "tutorial.html").as_uri())
    field = chromium.find_element("css selector", "input.md-search__input")
    field.click()
    field.send_keys("capture distance")
    found = WebDriverWait(chromium, 60).until(
        lambda page: [e.get_attribute("href") for e in page.find_elements("css selector", ".md-search-result__link")]
    )
    assert any("physics.html" in link or "scenario.html" in link for link in found)


# which parts are wider than what shows them: the page itself, and what scrolls by itself
WIDE = """
const wide = (element) => element.scrollWidth > element.clientWidth + 1;
const parts = document.querySelectorAll(".highlight code, .md-typeset__scrollwrap, .equation");
return [wide(document.documentElement), [...parts].filter(wide).map((part) => part.textContent)];
"""


@pytest.mark.nightly
def test_pages_fit_their_window(site, chromium):
    """At 1400 px no block of code, table or equation scrolls sideways; at 400 px they may, the page itself does not."""
    for page in sorted(site.rglob("*.html")):
        if page.name == "404.html":  # its links want a server
            continue
        for width in (1400, 400):
            resize(chromium, width)
            chromium.get(page.as_uri())
            whole, parts = chromium.execute_script(WIDE)
            assert (whole, parts if width == 1400 else []) == (False, []), (page, width)
