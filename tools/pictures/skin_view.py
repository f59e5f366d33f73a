"""Pictures of skin-view's page as a real browser shows it, once there is to be seen what each is to show.

Usage: python tools/pictures/skin_view.py FOLDER NAMESPACE CALM   (writes FOLDER/view*.png; see tools/picture)
"""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.browser.browsing import DRIVER, PHONE, READY, places, until, viewing
from tests.browser.chromium import chromium

PATIENCE_MS = 120_000
SIZE = (1200, 700)
EYE = "eye=0.02,-0.27,0.18,0.112,0.01,-0.004"
ALONG = "eye=-0.2,-0.13,0.22,0.115,0,0"
BELOW = "eye=0.02,-0.27,-0.18,0.112,0.01,-0.004"
"""Of an emulated arm: from above, along it from the elbow, and from below, where its boards 9 and 10 are."""


def taxels(condition: str, at_least: int) -> str:
    """JavaScript: so many of the taxels of the first driver's first two boards fulfil a condition on ``taxel``."""
    states = f"Array.from({{length: 384}}, (_, position) => skin.stateOf({DRIVER}, position))"
    return f"{states}.filter(taxel => taxel && {condition}).length >= {at_least}"


FRESH = taxels("taxel.mark === 'fresh'", 310)
PRESSED = f"{FRESH} && !skin.problems.length && " + taxels("taxel.level > 150", 8)


@dataclass(frozen=True)
class Shown:
    """One picture.

    Attributes:
        driver: whose.
        address: its part that says how it is looked at.
        seen: what has to be true in the page, JavaScript.
        size: of the window, CSS pixels.
        calm: of the namespace that skin-calm makes, instead of the drivers' own.
        pins: positions of taxels that are pinned, whose lines of 10 s are waited for.
    """

    driver: str
    address: str
    seen: str
    size: tuple[int, int] = SIZE
    calm: bool = False
    pins: tuple[int, ...] = ()


PICTURES = {
    "view": Shown("torso", f"theme=dark&{EYE}", PRESSED, pins=(124, 200)),
    "view-light": Shown("torso", f"theme=light&{EYE}", PRESSED),
    "view-phone": Shown("torso", f"theme=dark&{ALONG}", PRESSED, PHONE),
    "view-contacts": Shown(
        "arm",
        f"theme=light&{BELOW}",
        f"{FRESH} && skin.contacts.filter(contact => contact.load > 300).length >= 2",
        calm=True,
    ),
    "view-problem": Shown("broken", f"theme=dark&{EYE}", "skin.problems.length >= 3"),
}


def picture(browser: Browser, shown: Shown, namespace: str) -> Image.Image:
    """What a window shows once everything is there."""
    with viewing(shown.driver, "--namespace", namespace) as (_, url):
        page = browser.new_page(viewport={"width": shown.size[0], "height": shown.size[1]})
        page.goto(f"{url}#sharp=1&{shown.address}")
        until(page, f"{READY} && skin.drawn > 20", within_ms=PATIENCE_MS)
        for x, y in places(page, shown.pins):
            page.mouse.click(x, y)
        if shown.pins:
            page.mouse.move(1, 1)
            page.wait_for_timeout(10_000)
        until(page, shown.seen, within_ms=PATIENCE_MS)
        with Image.open(io.BytesIO(page.screenshot())) as image:
            done = image.convert("RGB")
        page.close()
    return done


def main() -> None:
    folder, own, calm = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    with chromium() as browser:
        for name, shown in PICTURES.items():
            file = folder / f"{name}.png"
            picture(browser, shown, calm if shown.calm else own).save(file, optimize=True)
            print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
