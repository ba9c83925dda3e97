"""The picture of `jaxquad app`: its simulated flight, tuned, in Chromium.

    python docs/site/screen.py

writes `docs/images/app.png`. It needs playwright and Debian's Chromium, and takes a minute.
"""

import io
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright


PICTURE = Path(__file__).parents[1] / "images" / "app.png"
WIDTH, HEIGHT = 1200, 1010  # pixels
_LATE = 300_000  # ms


def main() -> None:
    command = [sys.executable, "-m", "jaxquad", "app", "--no-browser"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        sync_playwright() as driver,
    ):
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(address)
        page.get_by_text("Try a simulated flight").click()
        page.get_by_role("link", name="Back to what flew").wait_for(timeout=_LATE)
        page.locator("h2", has_text="demo.bfl").evaluate("x => x.scrollIntoView()")
        page.wait_for_timeout(2000)  # until the figures are drawn
        image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        browser.close()
        server.send_signal(signal.SIGINT)
    image.quantize(64).save(PICTURE, optimize=True)
    print(PICTURE, PICTURE.stat().st_size)


if __name__ == "__main__":
    main()
