"""Tactile services: how well baselines hold beside the rules of others, and what they cost.

* speed: one frame of 30,848 taxels, for some patterns of touch; the rule of the iCub takes the same frames in turns.
* service: ``skin-calm`` on a driver of 30,848 taxels at 50 Hz: processor time of its whole process.
* worlds: 25 minutes of drift and touches (``bench_world``), many worlds for each drift and rate.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import fields

import numpy as np
import numpy.typing as npt

from skinware.tactile.baseline import Baseline
from tests.tactile.judging import Marks, Ours, Worlds, judge, peers
from tests.tactile.peers import ICub

TAXELS = 30_848
RATE_HZ = 50
MODULE, PATCH = np.arange(TAXELS) // 12, np.arange(TAXELS) // 192
WARM_UP, FRAMES = 400, 1000


def blobs(random: np.random.Generator) -> npt.NDArray[np.bool_]:
    """20 contacts of 47 taxels."""
    touched = np.zeros(TAXELS, bool)
    for first in random.integers(0, TAXELS - 47, 20).tolist():
        touched[first : first + 47] = True
    return touched


PATTERNS: dict[str, Callable[[np.random.Generator], npt.NDArray[np.bool_]]] = {
    "nothing": lambda _random: np.zeros(TAXELS, bool),
    "20 contacts": blobs,
    "half, at random": lambda random: random.random(TAXELS) < 0.5,
    "all": lambda _random: np.ones(TAXELS, bool),
}


def speed() -> None:
    """Milliseconds of one frame, by pattern."""
    random = np.random.default_rng(1)
    idle = np.round(15 + 0.8 * random.standard_normal((50, TAXELS), np.float32))
    print(f"one frame of {TAXELS} taxels in {PATCH.max() + 1} patches, {FRAMES} frames at {RATE_HZ} Hz, ms")
    for name, pattern in PATTERNS.items():
        ours, icub = Baseline(MODULE, PATCH), ICub.as_shipped(RATE_HZ)
        load = (pattern(random) * 30).astype(np.float32)
        taken: list[list[float]] = [[], []]
        busy: list[float] = []
        for number in range(WARM_UP + FRAMES):
            frame = idle[number % 50] + load * (number >= WARM_UP and number % 100 < 50)
            rules: tuple[Callable[..., object], ...] = (ours.update, icub)
            for times, rule in zip(taken, rules, strict=True):
                begin, busy_since = time.perf_counter(), time.thread_time()
                rule((number + 1) * 20_000_000, frame)
                times.append(1e3 * (time.perf_counter() - begin))
                busy.append(1e3 * (time.thread_time() - busy_since))
        mine, theirs = (np.array(times[WARM_UP:]) for times in taken)
        p50, p99, most = np.percentile(mine, 50), np.percentile(mine, 99), mine.max()
        busy_p99 = np.percentile(busy[2 * WARM_UP :: 2], 99)
        ratio = statistics.median((mine / theirs).tolist())
        text = f"p50 {p50:.2f}  p99 {p99:.2f}  most {most:.2f}  p99 of processor time {busy_p99:.2f}"
        print(f"  {name:<16} {text}  {ratio:.1f} times the rule of the iCub")
        print(f"  {'':<16} the rest taken, once: {max(taken[0][:WARM_UP]):.1f}")


def worlds(count: int, rates: list[float]) -> None:
    """The marks of all rules."""
    for rate_hz in rates:
        seen = Worlds(rate_hz, count)
        found = judge({"skinware": Ours(seen), **peers(rate_hz)}, seen)
        for (name, drift), marks in found.items():
            print(f"{rate_hz:g} Hz, {drift:<4} {name:<14} {line(marks)}", flush=True)


def line(marks: Marks) -> str:
    """Worst and best of each mark over the worlds."""
    texts = []
    for field in fields(marks):
        values = getattr(marks, field.name)
        unit = 1 if field.name.endswith("_s") else 100
        low, high = unit * values.min(), unit * values.max()
        texts.append(f"{field.name} {low:.3g}" + (f" to {high:.3g}" if high - low > 5e-3 * abs(high) else ""))
    return ", ".join(texts)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="*", choices=["speed", "worlds"], help="default: all")
    parser.add_argument("--worlds", type=int, default=20, help="of each drift, at each rate")
    parser.add_argument("--rates", default="20,50,100", help="Hz")
    arguments = parser.parse_args()
    parts = arguments.part or ["speed", "worlds"]
    if "speed" in parts:
        speed()
    if "worlds" in parts:
        worlds(arguments.worlds, [float(rate) for rate in arguments.rates.split(",")])


if __name__ == "__main__":
    main()
