"""Pictures of skin-view's page as a real browser shows it, once there is to be seen what each is to show.

Usage: python tools/pictures/skin_view.py FOLDER NAMESPACE CALM RECORDING
(writes FOLDER/view*.png and view.webp, which moves; see tools/picture)
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.browser.browsing import DRIVER, PHONE, READY, places, until, viewing
from tests.browser.chromium import chromium

PATIENCE_MS = 120_000
SIZE = (1200, 700)
EYE = "eye=0.02,-0.27,0.18,0.112,0.01,-0.004"
"""The eye sees an emulated arm from above."""
BOTH = "eye=0.2,-0.06,0.66,0.2,0.02,0"
"""The eye sees the arm and the hand beside it."""
MOVING = (1100, 640)
FRAMES, FRAME_MS = 40, 200
"""The moving picture has so many frames; ``]`` goes so far on in a recording."""
MOST_BYTES = 1_500_000


def taxels(condition: str, at_least: int) -> str:
    """JavaScript: so many of the taxels of the first driver's first two boards fulfil a condition on ``taxel``."""
    states = f"Array.from({{length: 384}}, (_, position) => skin.stateOf({DRIVER}, position))"
    return f"{states}.filter(taxel => taxel && {condition}).length >= {at_least}"


FRESH = taxels("taxel.mark === 'fresh'", 310)


def contacts(load: float, at_least: int) -> str:
    """JavaScript: so many contacts have such a load."""
    return f"skin.contacts.filter(one => one.load > {load}).length >= {at_least}"


@dataclass(frozen=True)
class Shown:
    """One picture.

    Attributes:
        drivers: whose.
        address: its part that says how it is looked at.
        seen: what has to be true in the page, JavaScript.
        size: of the window, CSS pixels.
        calm: of the namespace that skin-calm makes, instead of the drivers' own.
        pins: positions of taxels of the first driver that are pinned, whose lines of 10 s are waited for.
    """

    drivers: tuple[str, ...]
    address: str
    seen: str
    size: tuple[int, int] = SIZE
    calm: bool = True
    pins: tuple[int, ...] = ()


PICTURES = {
    "view": Shown(("arm", "hand"), f"theme=dark&{BOTH}", contacts(200, 3), pins=(124, 200)),
    "view-light": Shown(("hand",), "theme=light", contacts(2000, 1)),
    "view-phone": Shown(("hand",), "theme=dark", contacts(2000, 1), PHONE),
    "view-contacts": Shown(("arm",), f"theme=light&{EYE}", f"{FRESH} && {contacts(300, 2)}"),
    "view-problem": Shown(("broken",), f"theme=dark&{EYE}", "skin.problems.length >= 3", calm=False),
}


def screen(page: Page) -> Image.Image:
    """Return the picture in a window."""
    with Image.open(io.BytesIO(page.screenshot())) as image:
        return image.convert("RGB")


def picture(browser: Browser, shown: Shown, namespace: str) -> Image.Image:
    """Return the picture in a window once everything is there."""
    with viewing(*shown.drivers, "--namespace", namespace) as (_, url):
        page = browser.new_page(viewport={"width": shown.size[0], "height": shown.size[1]})
        page.goto(f"{url}#sharp=1&{shown.address}")
        until(page, f"{READY} && skin.drawn > 20", within_ms=PATIENCE_MS)
        for x, y in places(page, shown.pins):
            page.mouse.click(x, y)
        if shown.pins:
            page.mouse.move(1, 1)
            page.wait_for_timeout(10_000)
        until(page, shown.seen, within_ms=PATIENCE_MS)
        done = screen(page)
        page.close()
    return done


def moments(
    browser: Browser, recording: Path, address: str, size: tuple[int, int], n_drivers: int, first_s: float, n: int
) -> Iterator[tuple[float, Image.Image]]:
    """Yield pictures of a window that shows a recording, moment by moment: no slow machine is seen in them.

    Args:
        recording: of so many drivers.
        address: its part that says how it is looked at.
        size: of the window, CSS pixels.
        first_s: where the first picture is.
        n: number of pictures, each ``FRAME_MS`` after the one before.

    Yields:
        (time in the recording, s; picture).
    """
    with viewing(str(recording)) as (_, url):
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(f"{url}#sharp=1&t={first_s}&{address}")
        last_s = first_s + n * FRAME_MS / 1000
        until(
            page,
            f"window.skin?.drivers.length === {n_drivers} && skin.replays[0].paused"
            f" && skin.outlines[0].until_s > {last_s}",
            within_ms=PATIENCE_MS,
        )
        for number in range(n):
            drawn = page.evaluate("skin.turn")
            page.keyboard.press("]")
            time_s = first_s + (number + 1) * FRAME_MS / 1000
            until(page, f"skin.replays[0].time_s > {time_s - 0.05} && skin.turn > {drawn} + 2", within_ms=PATIENCE_MS)
            yield time_s, screen(page)
        page.close()


def save_moving(images: Sequence[Image.Image], file: Path) -> None:
    """Save a moving picture of at most ``MOST_BYTES``."""
    for quality in range(80, 10, -10):
        images[0].save(
            file, save_all=True, append_images=images[1:], duration=FRAME_MS, loop=0, quality=quality, method=4
        )
        if file.stat().st_size <= MOST_BYTES:
            return


def main() -> None:
    folder, own, calm, recording = Path(sys.argv[1]), sys.argv[2], sys.argv[3], Path(sys.argv[4])
    with chromium() as browser:
        seen = moments(browser, recording, f"theme=dark&{BOTH}", MOVING, 2, 1.0, FRAMES)
        save_moving([image for _, image in seen], folder / "view.webp")
        for name, shown in PICTURES.items():
            picture(browser, shown, calm if shown.calm else own).save(folder / f"{name}.png", optimize=True)
    for file in sorted(folder.glob("view*.*")):
        print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
