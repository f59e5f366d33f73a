"""Runs of frames lost at random, senders held up at random: is anything torn ever shown as fresh?

``tools/torn [--cycles 1000000] [--seed N] [--only NAME]``. Some bursts of every driver of the conformance tests, and of
fingertips with and without a counter, are recorded; then go through the driver's layout in variants of eight bursts,
with frames lost, repeated, late and caught up. ``one``: one run of frames is lost in a variant, and the sender may be
held up round it. ``many``: up to four things go wrong in it, one into the other.

A driver whose cycles have a counter must show nothing torn in either; one without, nothing in ``one``. What it shows in
``many`` are the cases of docs/explanation/layout.md, which no program can tell from good data. Exit status 1 if it is
otherwise.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from skinware import Namespace
from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import wire_dtype
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.fields import Identifier, SequenceNumber
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.rig import Suite, play
from skinware_drivers.testing.torn_tests import Bursts, FrameLog, find_torn, record
from skinware_drivers.virtual.hand_clock import HandClock

Indices = npt.NDArray[np.int64]
BURSTS, BEGIN = 8, 3
VARIANTS_AT_ONCE = 200
PERIOD_NS = 20_000_000


def recordings() -> Iterator[tuple[str, Bursts | None]]:
    """Names, and what to replay."""
    for order, age in (("given", 0.5), ("ends_with", 0.5), ("any", 0.25)):
        for counter in (None, SequenceNumber(0, "u1", mask=0x0F)):
            yield f"fingertip, {order}, {'4-bit counter' if counter else 'no counter'}", fingertip(order, age, counter)
    from tests.drivers import test_conformance

    for name, suite in vars(test_conformance).items():
        if name.startswith("Test") and isinstance(suite, type) and issubclass(suite, Suite):
            yield name.removeprefix("Test"), of_driver(suite())


def fingertip(order: Any, age: float, counter: SequenceNumber | None) -> Bursts:
    """Four frames of three taxels, with the number of the burst in the first byte."""
    frames = [
        Frame(f"quarter {i}", [Identifier(0x405 + 2 * i)], [7], Values(1, "<u2", 3, to=range(3 * i, 3 * i + 3)))
        for i in range(4)
    ]
    layout = Layout(frames, Cycle([f.name for f in frames], age * PERIOD_NS / 1e9, order=order, counter=counter))
    number = np.arange(4 * (BURSTS + 1))
    wire = np.zeros(len(number), wire_dtype(8))
    wire["payload"] = np.random.default_rng(1).integers(0, 256, wire["payload"].shape)
    wire["payload"][:, 0], wire["identifier"], wire["length"] = number // 4, 0x405 + 2 * (number % 4), 7
    tables = assemble([("bus", [Patch("p", [Module(taxels(12))])])], [PRESSURE.measured(unit="counts")], "u2")
    made = record(layout, tables, PERIOD_NS / 1e9, wire, number // 4 * PERIOD_NS + number % 4 * 200_000)
    assert made is not None
    return made


def of_driver(suite: Suite) -> Bursts | None:
    """What its emulator sends; None if a frame is all of an update."""

    async def scenario(clock: HandClock) -> Bursts | None:
        async with suite.running(clock) as rig:
            await until_fresh(rig)
            if not rig.adapter.layout.cycles:
                return None
            heard = FrameLog(rig)
            await rig.sleep((BURSTS + 4) * rig.adapter.period_s)
            return heard.recording(BURSTS)

    return play(scenario)


def suffer(recording: Bursts, troubles: int, random: np.random.Generator) -> tuple[Indices, Indices]:
    """Rows that arrive, and when, after so many things have gone wrong."""
    size, period_ns = recording.size, round(recording.period_s * 1e9)
    rows, time_ns = np.arange(len(recording.wire)), recording.time_ns.copy()
    for _ in range(troubles):
        first = BEGIN * size + int(random.integers(0, size if troubles == 1 else 3 * size))
        first = min(first, len(rows) - 1)
        lost = int(random.integers(0, 2 * size + 1)) if random.random() < 0.5 else size * int(random.integers(0, 3))
        if random.random() < 0.7:  # it stands still round the loss, and catches up
            held = max(0, first - int(random.integers(0, size + 1)))
            until_ns = time_ns[first] + int(random.uniform(0, 2.5) * period_ns)
            time_ns[held:] = np.maximum(time_ns[held:], until_ns)
        kept = np.ones(len(rows), bool)
        kept[first : first + lost] = False
        rows, time_ns = rows[kept], time_ns[kept]
        if len(rows) and random.random() < 0.1:  # one comes twice
            again = int(random.integers(0, len(rows)))
            rows, time_ns = np.insert(rows, again, rows[again]), np.insert(time_ns, again, time_ns[again])
    behind_ns = np.arange(len(rows)) * int(random.choice((0, 20_000, 200_000)))
    return rows, np.maximum.accumulate(time_ns - behind_ns) + behind_ns


def run(recording: Bursts, cycles: int, most: int, seed: int) -> tuple[int, int, int]:
    """Replay at least so many cycles; returns how many were sent, shown as fresh, and torn."""
    random = np.random.default_rng(seed)
    modules = max(1, len(np.unique(find_torn(recording, np.arange(len(recording.wire)), recording.time_ns)[0].module)))
    span_ns = round(3 * BURSTS * recording.period_s * 1e9)
    sent = shown = torn = 0
    while sent < cycles:
        parts = [suffer(recording, int(random.integers(1, most + 1)), random) for _ in range(VARIANTS_AT_ONCE)]
        rows = np.concatenate([rows for rows, _ in parts])
        time_ns = np.concatenate([time_ns + number * span_ns for number, (_, time_ns) in enumerate(parts)])
        fresh, is_torn = find_torn(recording, rows, time_ns)
        sent, shown = sent + VARIANTS_AT_ONCE * BURSTS * modules, shown + len(fresh.module)
        torn += int(is_torn.sum())
    return sent, shown, torn


@contextmanager
def own_namespace() -> Iterator[None]:
    """A namespace that is gone afterwards."""
    os.environ["SKINWARE_NAMESPACE"] = f"torn-{os.getpid()}"
    try:
        yield
    finally:
        shutil.rmtree(Namespace().path, ignore_errors=True)


def main() -> int:
    """Print a line a driver."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=1_000_000, help="of each driver, in each way")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 1_000_000)
    parser.add_argument("--only", default="", help="drivers whose name contains this")
    given = parser.parse_args()
    print(f"seed {given.seed}\n{'':40} {'cycles':>9}  {'one: shown':>10} {'torn':>5}  {'many: shown':>11} {'torn':>5}")
    failed = False
    with own_namespace():
        for name, recording in recordings():
            if given.only not in name:
                continue
            if recording is None:
                print(f"{name:40} one frame is all of an update: nothing to tear")
                continue
            counted = recording.layout.cycle is not None and recording.layout.cycle.counter is not None
            cycles, shown, torn = run(recording, given.cycles, 1, given.seed)
            _, shown_of_many, torn_of_many = run(recording, given.cycles, 4, given.seed)
            wrong = torn > 0 or (counted and torn_of_many > 0)
            failed |= wrong
            words = " TORN" if wrong else ""
            print(f"{name:40} {cycles:9}  {shown:10} {torn:5}  {shown_of_many:11} {torn_of_many:5}{words}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
