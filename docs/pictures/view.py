"""Pictures of the live view: its page in a headless browser, with images of a platform and acoustic maps of a leak.

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
"""Number of simulated measurements of the platform, and the one that is drawn, in which the person is near."""


def view() -> None:
    """Draw the page when the person of `examples/platform.toml` is near."""
    platform = HERE.parents[1] / "examples" / "platform.toml"
    draw(platform, MOMENTS, "view.png", "--decay", "1", moment=MOMENT)


def acoustic_maps() -> None:
    """Draw the page with the acoustic map of a leak, in the band in which it is loudest."""
    leak = HERE.parents[1] / "data" / "synthetic" / "scenes" / "leak.toml"
    draw(leak, 2, "acoustic_maps_view.png", "--band", "63000", moment=1)


def draw(scene: Path, count: int, picture: str, *options: str, moment: int) -> None:
    """Simulate measurements of a scene, and draw the page that shows one of them."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = Path(folder) / f"{scene.stem}.h5"
        subprocess.run([*ERTIS, "simulate", scene, "--count", str(count), "-o", path, "-q"], check=True)  # noqa: S603
        command = [*ERTIS, "view", path, *options, "--port", "0", "--no-open", "--quiet", "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603
            assert process.stdout is not None  # noqa: S101  it is a pipe
            url = json.loads(process.stdout.readline())["url"]
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            try:
                page = browser.new_page(viewport={"width": 1500, "height": 860})
                page.set_default_timeout(120_000.0)
                page.goto(url)
                _save(page, picture, moment)
            finally:
                browser.close()
                process.terminate()


def _save(page: Page, name: str, moment: int) -> None:
    """Wait until the measurement is drawn, and save the page."""
    page.wait_for_selector("canvas")
    line = page.locator("label", has_text="Measurement").locator("xpath=ancestor::div[.//input][1]")
    page.get_by_role("button", name="Play", exact=True).wait_for()  # the file has played to its end
    for number in (0, moment):
        box = line.locator("input:not([type=hidden])").last
        box.fill(str(number))
        box.press("Enter")
        page.wait_for_function(
            "() => document.querySelector('[data-name=sequence]').innerText.split(', ')"
            f".every(each => each.split(' ').at(-1) === '{number}')"
        )
    for notice in page.locator(".mantine-Notification-closeButton").all():  # warnings about a missing graphics card
        notice.click()
    page.wait_for_timeout(3000)  # the page does not report the end of drawing
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.save(HERE / name, optimize=True)


if __name__ == "__main__":
    view()
    acoustic_maps()
