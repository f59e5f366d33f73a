"""Contacts: what finding and following them costs at 30,848 taxels, alone and after a baseline, by pattern of touch."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.tactile.baseline import Baseline
from skinware.tactile.contacts import Contacts
from skinware.tactile.neighbours import neighbours
from tests.tactile.skins import PITCH_M, placed, triangles

TAXELS, RATE_HZ, FRAMES = 30_848, 50, 500
PERIOD_NS = round(1e9 / RATE_HZ)
MODULE, PATCH = np.arange(TAXELS) // 12, np.arange(TAXELS) // 192
FINGERS, REACH_M = 20, 0.024
Values = npt.NDArray[np.float32]
Pattern = Callable[[Geometry, np.random.Generator], Iterator[Values]]


def fingers(geometry: Geometry, random: np.random.Generator) -> Iterator[Values]:
    """20 fingers that wander about, 0.1 m/s fast, of about 47 taxels each."""
    position = geometry.position_m
    size = position.max(axis=0)
    at_m = random.uniform(0, 1, (FINGERS, 3)) * size
    way = random.normal(size=(FINGERS, 3)) * (0.1 / RATE_HZ)
    while True:
        at_m += way
        way[(at_m < 0) | (at_m > size)] *= -1
        load = np.zeros(TAXELS, np.float32)
        for place in at_m:
            near = np.flatnonzero(np.abs(position - place).max(axis=1) < REACH_M)
            away = ((position[near] - place) ** 2).sum(axis=1) / (REACH_M / 2) ** 2
            load[near] = np.maximum(load[near], 40 * np.exp(-away))
        yield load


def at_random(share: float) -> Pattern:
    def pattern(_geometry: Geometry, random: np.random.Generator) -> Iterator[Values]:
        while True:
            yield (30.0 * (random.random(TAXELS) < share)).astype(np.float32)

    return pattern


def snake(geometry: Geometry, _random: np.random.Generator) -> Iterator[Values]:
    """One contact that winds through the whole skin: the longest way from end to end."""
    row = np.round(geometry.position_m[:, 1] / (PITCH_M * np.sqrt(0.75))).astype(int)
    left = geometry.position_m[:, 0] < 3 * PITCH_M
    right = geometry.position_m[:, 0] > geometry.position_m[:, 0].max() - 3 * PITCH_M
    load = 30.0 * ((row % 4 == 0) | ((row % 8 < 4) & left) | ((row % 8 >= 4) & right))
    while True:
        yield load.astype(np.float32)


PATTERNS: dict[str, Pattern] = {
    "nothing": at_random(0.0),
    "20 fingers": fingers,
    "1 % at random": at_random(0.01),
    "10 % at random": at_random(0.1),
    "half, at random": at_random(0.5),
    "a snake": snake,
    "all": at_random(1.0),
}


def figures(times_ms: list[float]) -> str:
    p50, p99 = np.percentile(times_ms, [50, 99])
    return f"p50 {p50:.2f}  p99 {p99:.2f}  most {max(times_ms):.2f}"


def speed() -> None:
    """Milliseconds of one frame, by pattern; in two numberings of the taxels."""
    lattice = triangles(176, 176)[:TAXELS]
    begin = time.perf_counter()
    neighbours(placed(lattice))
    print(f"neighbours of {TAXELS} taxels, once: {1e3 * (time.perf_counter() - begin):.0f} ms")
    print(f"one frame, {FRAMES} frames at {RATE_HZ} Hz, ms of processor time (and most by the clock)")
    for numbering in ("row by row", "in no order"):
        random = np.random.default_rng(1)
        order = np.arange(TAXELS) if numbering == "row by row" else random.permutation(TAXELS)
        geometry = placed(lattice[order], normal=np.tile([0.0, 0.0, 1.0], (TAXELS, 1)))
        table = neighbours(geometry)
        for name, pattern in PATTERNS.items():
            contacts, baseline = Contacts(TAXELS, table, geometry, unit="Pa"), Baseline(MODULE, PATCH)
            alone_ms, both_ms, most_ms, found = [], [], 0.0, 0
            loads, time_ns = pattern(geometry, random), 0
            idle = np.round(15 + 0.8 * random.standard_normal((50, TAXELS), np.float32))
            for number in range(300 + FRAMES):
                time_ns += PERIOD_NS
                frame = idle[number % 50]
                if number >= 300:
                    frame = frame + next(loads) * (number % 100 < 80)
                clock, begin = time.perf_counter(), time.thread_time()
                calm = baseline.update(time_ns, frame)
                between = time.thread_time()
                contact_set = contacts.update(calm.value, calm.touched, time_ns)
                end = time.thread_time()
                if number >= 300:
                    alone_ms.append(1e3 * (end - between))
                    both_ms.append(1e3 * (end - begin))
                    most_ms = max(most_ms, 1e3 * (time.perf_counter() - clock))
                    found = max(found, len(contact_set) + contact_set.beyond)
            print(f"  {numbering}, {name:<16} contacts alone: {figures(alone_ms)}; up to {found} at a time")
            print(f"  {'':<{len(numbering) + 18}} with baseline:  {figures(both_ms)} ({most_ms:.2f})", flush=True)


if __name__ == "__main__":
    speed()
