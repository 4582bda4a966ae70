"""Picture of the live view: its page in a headless browser, with the platform of the examples.

This script needs the extras view and browser, and Chromium.
"""

import io
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

try:
    from playwright.sync_api import Page, sync_playwright
except ImportError as error:
    sys.exit(f"the picture of the live view needs playwright ({error}); run \"pip install 'ertis-numba[browser]'\"")

HERE = Path(__file__).parent
ERTIS = (sys.executable, "-m", "ertis_cli.main")
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-sync")
MOMENTS, MOMENT = 14, 12
"""Number of simulated measurements, and the one that is drawn, in which the person is near."""


def view() -> None:
    """Draw the page when the person of `examples/platform.toml` is near."""
    platform = HERE.parents[1] / "examples" / "platform.toml"
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = Path(folder) / "platform.h5"
        subprocess.run([*ERTIS, "simulate", platform, "--count", str(MOMENTS), "-o", path, "-q"], check=True)  # noqa: S603
        command = [*ERTIS, "view", path, "--decay", "1", "--port", "0", "--no-open", "--quiet", "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603
            assert process.stdout is not None  # noqa: S101  it is a pipe
            url = json.loads(process.stdout.readline())["url"]
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            try:
                page = browser.new_page(viewport={"width": 1500, "height": 860})
                page.set_default_timeout(120_000.0)
                page.goto(url)
                _save(page)
            finally:
                browser.close()
                process.terminate()


def _save(page: Page) -> None:
    """Wait until the measurement is drawn, and save the page."""
    page.wait_for_selector("canvas")
    line = page.locator("label", has_text="Measurement").locator("xpath=ancestor::div[.//input][1]")
    page.get_by_role("button", name="Play", exact=True).wait_for()  # the file has played to its end
    for moment in (0, MOMENT):
        box = line.locator("input:not([type=hidden])").last
        box.fill(str(moment))
        box.press("Enter")
        page.wait_for_function(
            "() => document.querySelector('[data-name=sequence]').innerText.split(', ')"
            f".every(each => each.endsWith(' {moment}'))"
        )
    for notice in page.locator(".mantine-Notification-closeButton").all():  # warnings about a missing graphics card
        notice.click()
    page.wait_for_timeout(3000)  # the page does not report the end of drawing
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.save(HERE / "view.png", optimize=True)


if __name__ == "__main__":
    view()
