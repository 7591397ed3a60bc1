"""Draw the pictures of docs/start/ from the folders that its commands wrote: the report, the way of a search, a walk.

python docs/images/first_pages.py results docs/images
"""

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from selenium import webdriver

FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars")
WIDTH = 445  # px of a report: the table's first columns fit
BOTTOM = "return document.querySelector('.controls.hint').getBoundingClientRect().bottom"  # of the map's legend
COLOURS, HEIGHT, QUALITY = 64, 1260, 75


def main(results: str, folder: str) -> None:
    """Draw all of them."""
    for ending, picture in first_screens(Path(results, "case_1_2", "report.html")).items():
        picture.save(Path(folder, f"report{ending}.webp"), quality=QUALITY, method=6)
    path = Image.open(Path(results, "tuned", "path.png")).convert("RGB")
    path.quantize(COLOURS).save(Path(folder, "tuned_path.png"), optimize=True)
    walk = Image.open(Path(results, "tuned_walk", "comparison.png")).convert("RGB")
    walk = walk.resize((walk.width * HEIGHT // walk.height, HEIGHT))
    walk.save(Path(folder, "tuned_walk.webp"), quality=QUALITY, method=6)


def first_screens(report: Path) -> dict[str, Image.Image]:
    """Return a report down to its first map as Chromium shows it on a phone, on light and on dark ground."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for flag in FLAGS:
        options.add_argument(flag)
    pictures = {}
    with webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver"))) as browser:
        for ending, scheme in (("", "light"), ("_dark", "dark")):
            said = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", said)
            resize(browser, 1000)
            browser.get(report.resolve().as_uri())
            resize(browser, int(browser.execute_script(BOTTOM)) + 2)
            pictures[ending] = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    return pictures


def resize(browser: webdriver.Chrome, height: int) -> None:
    """Give the page a window of this height, px."""
    size = {"width": WIDTH, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


if __name__ == "__main__":
    main(*sys.argv[1:])
