"""The documentation as a site, opened from disk in a real browser."""

import html
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import mjx_climb as mc
from mjx_climb.walk.sample import Sample

ROOT = Path(__file__).parents[2]
FLAGS = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("material", reason="needs the extra docs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    return folder


@pytest.mark.slow
def test_the_reference_shows_every_field(site):
    """Of each public record, and of the sample that laws and metrics see, with what the code says of it."""
    page = html.unescape((site / "reference" / "mjx_climb.html").read_text("utf-8"))
    parts = dict(re.findall(r'<h3 id="([\w.]+)"(.*?)(?=<h[23] |$)', page, re.DOTALL))
    records = [Sample, *(kind for kind in map(mc.__dict__.get, mc.__all__) if isinstance(kind, type))]
    for kind in records:
        fields = getattr(kind, "_fields", None) or [f.name for f in getattr(kind, "__dataclass_fields__", {}).values()]
        text = parts[f"{kind.__module__}.{kind.__name__}"]
        assert not [name for name in fields if name.islower() and f">{name}</span></code></b>" not in text], kind
    command = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", parts["mjx_climb.control.law.Command"]))
    assert "(6, B) m, rad: the law's shift of the base, reference axes" in command


@pytest.mark.slow
def test_the_search_works_from_disk(site, tmp_path):
    selenium = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    from selenium.webdriver.support.wait import WebDriverWait

    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in programs:
        pytest.skip("needs chromium and chromedriver")
    options = selenium.ChromeOptions()
    options.binary_location = programs[0]
    for flag in [*FLAGS.split(), "--window-size=1300,900", f"--user-data-dir={tmp_path}"]:
        options.add_argument(flag)
    driver = selenium.Chrome(options=options, service=selenium.ChromeService(programs[1]))
    try:
        driver.get((site / "tutorial.html").as_uri())
        field = driver.find_element("css selector", "input.md-search__input")
        field.click()
        field.send_keys("capture distance")
        found = WebDriverWait(driver, 60).until(
            lambda page: [
                e.get_attribute("href") for e in page.find_elements("css selector", ".md-search-result__link")
            ]
        )
        assert any("physics.html" in link or "scenarios.html" in link for link in found)
    finally:
        driver.quit()
