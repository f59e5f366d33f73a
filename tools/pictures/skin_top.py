"""A picture of the real skin-top: waits until somebody presses the skin, and saves what is on the screen as SVG.

Usage: python tools/pictures/skin_top.py FILE.svg NAMESPACE        (a driver must run there; tools/picture starts it)

Beside contacts it draws the whole driver with them; otherwise board 7.
"""

from __future__ import annotations

import asyncio
import re
import sys
from pathlib import Path

from textual.pilot import Pilot
from textual.widgets import Static

from skinware import Namespace
from skinware.cli._heat_map import BACKGROUND, LEVELS
from skinware.cli._painting import TRUE_COLOURS
from skinware.cli._top_app import SkinTop
from skinware.cli._top_list import DriverList

SIZE = (80, 24)
PATIENCE_S = 120.0
_FONTS = "ui-monospace, 'DejaVu Sans Mono', Menlo, Consolas, monospace"


async def picture(namespace: str) -> str:
    """The screen as SVG."""
    app = SkinTop(Namespace(namespace), palette=TRUE_COLOURS)
    async with app.run_test(size=SIZE) as pilot:
        async with asyncio.timeout(PATIENCE_S):
            while not app.query_one(DriverList).rows or not app._overview.drivers.look()[0].frame:
                await pilot.pause(0.1)
            if app._overview.contacts.readers:
                await _followed(app, pilot)
            else:
                await pilot.press("down", "down")
                await _pressed(app, pilot)
        return plain(app.export_screenshot(title="skin-top"))


async def _followed(app: SkinTop, pilot: Pilot[None]) -> None:
    """Wait until nearly all sensors are at rest, and two contacts are there for a while."""
    while True:
        await pilot.pause(0.05)
        (driver,) = app._overview.drivers.look()
        contacts = app._overview.contacts.of(driver.name)
        rested = driver.frame is not None and (driver.frame.status == 0).mean() > 0.98
        if rested and contacts and len(contacts.contacts) == 2 and contacts.contacts.age_s.min() > 1.5:
            return


async def _pressed(app: SkinTop, pilot: Pilot[None]) -> None:
    """Wait until a finger is on the board that is drawn."""
    while True:
        await pilot.pause(0.05)
        pixels = app._picture.pixels
        felt = pixels[pixels != BACKGROUND] % LEVELS
        if str(app.query_one("#title", Static).content).startswith("board 7") and (felt > LEVELS - 4).sum() >= 24:
            return


def plain(svg: str) -> str:
    """The same without anything from elsewhere: whoever looks at it uses a font of their own."""
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r"@font-face\s*{.*?}\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r"font-family:\s*[^;]*;", f"font-family: {_FONTS};", svg)
    return "\n".join(line.rstrip() for line in svg.splitlines() if line.strip()) + "\n"


if __name__ == "__main__":
    file = Path(sys.argv[1])
    file.write_text(asyncio.run(picture(sys.argv[2])), encoding="utf-8")
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")
