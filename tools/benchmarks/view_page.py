"""The page of skin-view in Chromium with WebGL in software: pictures drawn per second, and what skin-view costs.

tools/bench view-page [--seconds S] [--sensors N ...] [--hz HZ] [--size WIDTHxHEIGHT]

A driver in a process of its own publishes a skin on a closed sleeve, with noise on every sensor, a touch that moves,
and contacts of it; one page shows it with names, contacts and the plot of a taxel. The share of a core is that of
skin-view (Python), without its start and the first turns. Where there is no graphics card, the browser itself computes
every pixel, and takes what the machine has. A longer run prints the memory of skin-view and of the page each minute.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from processes import Processes, answer, own_namespace

from skinware import DriverWriter, Structure
from skinware.geometry import Geometry
from skinware.realtime import Periodic, now_ns
from skinware.sensor_types import PRESSURE
from skinware.tactile.contacts_service import ContactsWriter

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.browser.browsing import DRIVER, tell, until, viewing
from tests.browser.chromium import chromium, process_of, processes_of, program

SENSORS = (5_376, 30_848)
LEAST_FPS = {5_376: 25, 30_848: 10}
MOST_SHARE = 0.04
REPORT_S = 60
CONTACTS_EVERY = 5
PATIENCE_MS = 60_000
PER_MODULE, PER_PATCH = 16, 16
PITCH_M = 0.004
NOISE = 2.0


def sleeve(sensors: int) -> Structure:
    """Rings of taxels about the z axis, twice as long as around."""
    modules = sensors // PER_MODULE
    patches = -(-modules // PER_PATCH)
    around = round((sensors / 2) ** 0.5)
    ring, step = np.divmod(np.arange(sensors), around)
    angle = 2 * np.pi * step / around
    normal = np.column_stack((np.cos(angle), np.sin(angle), np.zeros(sensors)))
    places = Geometry(
        type_name=np.full(sensors, "pressure"),
        uid=np.arange(sensors, dtype=np.uint64),
        frame=np.full(sensors, "arm"),
        position_m=normal * PITCH_M * around / (2 * np.pi) + np.outer(ring * PITCH_M, [0, 0, 1.0]),
        normal=normal,
        radius_m=np.full(sensors, PITCH_M / 3),
        confidence=np.full(sensors, np.nan),
    )
    return Structure(
        types=[PRESSURE.measured(unit="counts", minimum=0, maximum=4095)],
        buses=["can0"],
        patch_name=[f"board {n}" for n in range(patches)],
        patch_bus=[0] * patches,
        module_patch=np.arange(modules) // PER_PATCH,
        module_kind=["triangle"] * modules,
        sensor_uid=np.arange(sensors),
        sensor_type=[PRESSURE.id] * sensors,
        sensor_module=np.arange(sensors) // PER_MODULE,
        dtype="u2",
        geometry=places,
    )


def drive(pipe: Connection, namespace: str, sensors: int, rate_hz: float) -> None:
    """Publish until the other end says enough; then how many frames came too late."""
    generator = np.random.default_rng(1)
    noise = np.round(generator.normal(0, NOISE, (64, sensors))).astype(np.int64)
    place = np.arange(sensors)
    structure = sleeve(sensors)
    with (
        DriverWriter("large", structure, namespace=namespace, rate_hz=rate_hz) as writer,
        ContactsWriter(structure, driver="large", namespace=namespace) as contacts,
    ):
        timer = Periodic(rate_hz)
        while not pipe.poll():
            columns = writer.begin()
            columns["values"][:] = (
                1000
                + noise[generator.integers(64)]
                + 2500 * np.exp(-(((place - writer.sequence * 40 % sensors) / 200) ** 2))
            )
            columns["status"][:] = 0
            columns["patch_state"][:] = 1
            columns["bus_state"][:] = 1
            columns["module_time_ns"][:] = now_ns()
            value = np.maximum(0, columns["values"].astype(np.float32) - 1100)
            writer.commit(now_ns())
            if writer.sequence % CONTACTS_EVERY == 0:
                contacts.publish(value, value > 0, now_ns())
            if writer.sequence == 1:
                pipe.send("ready")
            timer.wait()
        pipe.send(timer.missed)


@contextmanager
def driving(namespace: str, sensors: int, rate_hz: float) -> Iterator[None]:
    with Processes() as processes:
        pipe = processes.start(drive, namespace, sensors, rate_hz)
        answer(pipe, 60)
        try:
            yield
        finally:
            pipe.send("enough")
            print(f"          the driver was late for {answer(pipe, 30)} frames")


def cpu_s(*processes: int) -> float:
    """Processor time of processes so far; of those that have ended, none."""
    total = 0
    for process in processes:
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
            total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK")


def megabytes(*processes: int) -> float:
    """Memory of processes that is theirs, each page that several share as its part."""
    total = 0
    for process in processes:
        with contextlib.suppress(OSError):
            text = Path(f"/proc/{process}/smaps_rollup").read_text()
            total += int(text.partition("Pss:")[2].split()[0])
    return total / 1e3


def measure(sensors: int, seconds: float, rate_hz: float, size: tuple[int, int]) -> None:
    """One row of the report."""
    with (
        own_namespace() as namespace,
        driving(namespace.name, sensors, rate_hz),
        viewing("--namespace", namespace.name) as (view, url),
        chromium() as browser,
    ):
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(url)
        until(page, "window.skin?.drawn > 20", within_ms=PATIENCE_MS)
        until(page, "skin.contacts.length", within_ms=PATIENCE_MS)
        page.mouse.move(*tell(page, f"skin.pixelOf({DRIVER}, 0)"))
        page.keyboard.press("g")
        until(page, "skin.plots.length", within_ms=PATIENCE_MS)
        its_processes = processes_of(os.getsid(process_of(browser)))
        begin_s, python_s, browser_s = time.monotonic(), cpu_s(view.process.pid), cpu_s(*its_processes)
        drawn, turns = tell(page, "[skin.drawn, skin.turn]")
        while (left_s := begin_s + seconds - time.monotonic()) > 0:
            memory = [megabytes(view.process.pid), megabytes(*its_processes)]
            if seconds > REPORT_S:
                print(
                    f"  {time.monotonic() - begin_s:6.0f} s: skin-view {memory[0]:.1f} MB, browser {memory[1]:.0f} MB,",
                    end=" ",
                )
                print(f"heap {tell(page, 'performance.memory.usedJSHeapSize') / 1e6:.0f} MB", flush=True)
            time.sleep(min(left_s, REPORT_S))
        drawn_now, turns_now, ratio = tell(page, "[skin.drawn, skin.turn, skin.ratio]")
        passed_s = time.monotonic() - begin_s
        share = (cpu_s(view.process.pid) - python_s) / passed_s
        browser_s = cpu_s(*its_processes) - browser_s
    fps, pictures = (drawn_now - drawn) / passed_s, max(drawn_now - drawn, 1)
    cheap = "met" if share <= MOST_SHARE else "MISSED"
    print(
        f"  {sensors:6} taxels  {fps:5.1f} pictures/s drawn{judged(fps, sensors)},"
        f" {(turns_now - turns) / passed_s:.1f} turns/s, at {ratio:g} of the pixels each way;"
        f" browser {1e3 * browser_s / pictures:.0f} ms of processors a picture;"
        f" skin-view {share:.1%} of a core ({cheap}: at most {MOST_SHARE:.0%}); load {os.getloadavg()[0]:.1f}",
        flush=True,
    )


def judged(fps: float, sensors: int) -> str:
    """What is asked for, where something is."""
    least = LEAST_FPS.get(sensors)
    return "" if least is None else f" ({'met' if fps >= least else 'MISSED'}: at least {least:.1f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--sensors", type=int, nargs="+", default=list(SENSORS), metavar="N")
    parser.add_argument("--hz", type=float, default=50.0, help="of the driver")
    parser.add_argument("--size", default="1280x800", help="of the window, CSS pixels")
    options = parser.parse_args()
    if program() is None:
        sys.exit("there is no Chromium (Debian: apt install chromium)")
    width, height = map(int, options.size.split("x"))
    print(f"{options.size}, driver at {options.hz:g} Hz, {options.seconds:g} s each; load {os.getloadavg()[0]:.1f}")
    for sensors in options.sensors:
        measure(sensors, options.seconds, options.hz, (width, height))


if __name__ == "__main__":
    main()
