"""The pictures of docs/drivers: what skin-view shows of each driver's emulator, touched.

Usage: python tools/pictures/drivers.py FOLDER [NAME...]      (writes FOLDER/NAME.webp, of all drivers without names)
"""

from __future__ import annotations

import io
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from PIL import Image
from playwright.sync_api import Browser

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.browser.browsing import READY, until, viewing
from tests.browser.chromium import chromium
from tests.commands import running

PATIENCE_MS = 120_000
SIZE = (1130, 640)
WATCHED_MS = 9000
WATCH = """() => {
  const taxels = Array.from({ length: 1200 }, (_, position) => position);
  const driver = skin.drivers[0].id;
  const of = (taxel) => (taxel?.mark === "stale" ? -99 : (taxel?.level ?? 0) % 255);
  window.score = () => taxels.reduce((sum, position) => sum + of(skin.stateOf(driver, position)), 0);
  window.best = 0;
  setInterval(() => (window.best = Math.max(0.995 * window.best, window.score())), 100);
}"""
"""How strongly all taxels are touched, and the most so far: patterns of emulators come again."""


class Shown(NamedTuple):
    """An emulator and how it is looked at.

    Attributes:
        bus: that the driver gets; ``{port}`` is the emulator's.
        driver, emulator: further arguments; None for an emulator that comes with the bus.
        address: its part that says how it is looked at.
    """

    bus: str = "virtual"
    driver: tuple[str, ...] = ()
    emulator: tuple[str, ...] | None = None
    address: str = "normals=0"


def _pty(*emulator: str, bus: str = "{port}", driver: tuple[str, ...] = ()) -> Shown:
    return Shown(bus, driver, ("--bus", "pty:{port}", *emulator))


SHOWN: Mapping[str, Shown] = {
    "ability_hand": Shown(),
    "agni": _pty("--sensors", "16,4"),
    "allegro_v5": Shown(),
    "anyskin": _pty(),
    "barrett": Shown(),
    "canopen": Shown(),
    "cyskin_cpm": Shown(address="mode=change"),
    "dev001": _pty("--period-ms", "10", driver=("--rate-hz", "100")),
    "dex3": Shown("virtual?period_ms=20", ("--period-ms", "20"), address="scale=100000,350000"),
    "dfrobot": _pty("--units", "1,2", "--shapes", "6x6,4x8", bus="modbus:{port}", driver=("--units", "1,2")),
    "flexitac": Shown(),
    "icub_eth": Shown(),
    "inspire": Shown("modbus:tcp://127.0.0.1:6055", emulator=("--bus", "modbus:tcp://:6055")),
    "linkerhand": Shown(),
    "papillarray": Shown(driver=("--rate-hz", "100")),
    "paxini": _pty("--board", "high_speed"),
    "revo2": _pty(bus="modbus:{port}", driver=("--enable",)),
    "revo3": _pty(bus="modbus:{port}"),
    "robotiq_tsf": Shown(address="scale=400,9500"),
    "ros2": Shown(),
    "skintalk": _pty()._replace(address="mode=change"),
    "tactile_glove": _pty(),
    "tesollo": Shown(),
    "weiss_dsa": _pty(),
    "weiss_wts": _pty("--columns", "4", "--rows", "8"),
    "wuji_glove": _pty(),
    "xela": Shown("virtual?calm_s=6", address="mode=change"),
    "xela_server": Shown(),
    "yarp": Shown(),
}


@contextmanager
def emulated(name: str, shown: Shown) -> Iterator[None]:
    """The driver with its emulator, in a namespace of their own."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as programs:
        port = f"{folder}/port"
        if shown.emulator is not None:
            arguments = [one.format(port=port) for one in shown.emulator]
            programs.enter_context(running("skin-emulate", "--driver", name, *arguments))
        bus = shown.bus.format(port=port)
        programs.enter_context(running("skin-driver", "--wait", "--driver", name, "--bus", bus, *shown.driver))
        yield


def picture(browser: Browser, shown: Shown) -> Image.Image:
    """Return the picture on the stage once everything is there."""
    with viewing() as (_, url):
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.goto(f"{url}#sharp=1&theme=light&{shown.address}")
        until(page, READY, within_ms=PATIENCE_MS)
        page.evaluate(WATCH)
        page.wait_for_timeout(WATCHED_MS)
        shot = b""
        while not shot or page.evaluate("window.score() <= 0"):  # it became stale: the machine is busy
            until(page, "window.score() > 0 && window.score() > 0.9 * window.best", within_ms=PATIENCE_MS)
            shot = page.locator("#view").screenshot()
        with Image.open(io.BytesIO(shot)) as image:
            done = image.convert("RGB")
        page.close()
    return done


def main() -> None:
    folder, names = Path(sys.argv[1]), sys.argv[2:] or list(SHOWN)
    folder.mkdir(parents=True, exist_ok=True)
    with chromium() as browser:
        for name in names:
            namespace = os.environ["SKINWARE_NAMESPACE"] = f"picture-{name}"
            file = folder / f"{name}.webp"
            with emulated(name, SHOWN[name]):
                picture(browser, SHOWN[name]).save(file, quality=80, method=6)
            shutil.rmtree(f"/dev/shm/skinware.{namespace}", ignore_errors=True)
            print(f"{file}: {file.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
