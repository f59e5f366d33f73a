"""Health: what is found of planted faults, by their size, and what it costs beside the baseline at 30,848 taxels."""

from __future__ import annotations

import time

import contacts
import numpy as np
import numpy.typing as npt
from contacts import FRAMES, MODULE, PATCH, PERIOD_NS, TAXELS, figures

from skinware.tactile.baseline import Baseline
from skinware.tactile.health import Health, HealthKind
from tests.tactile.skins import placed, triangles
from tests.tactile.test_health import PLATES, QUICK, chosen, judged, plates

SETTLED = 300
SEEDS = range(100, 105)


def speed() -> None:
    """Milliseconds of one frame, by pattern of touch; the baseline takes the same frames in turns."""
    geometry = placed(triangles(176, 176)[:TAXELS], normal=np.tile([0.0, 0.0, 1.0], (TAXELS, 1)))
    begin = time.perf_counter()
    Health(MODULE, geometry)
    print(f"made for {TAXELS} taxels, once: {1e3 * (time.perf_counter() - begin):.0f} ms")
    print(f"one frame, {FRAMES} frames at 50 Hz, ms of processor time")
    for name, pattern in contacts.PATTERNS.items():
        random = np.random.default_rng(1)
        baseline, health = Baseline(MODULE, PATCH), Health(MODULE, geometry, limits=(0, 255))
        loads = pattern(geometry, random)
        idle = np.round(15 + 0.8 * random.standard_normal((50, TAXELS), np.float32))
        baseline_ms, health_ms, report_ms = [], [], []
        for number in range(SETTLED + FRAMES):
            time_ns, frame = (number + 1) * PERIOD_NS, idle[number % 50]
            if number >= SETTLED:
                frame = frame + next(loads) * (number % 100 < 80)
            begin = time.thread_time()
            calm = baseline.update(time_ns, frame)
            between = time.thread_time()
            health.update(time_ns, frame, calm)
            end = time.thread_time()
            if number >= SETTLED:
                baseline_ms.append(1e3 * (between - begin))
                health_ms.append(1e3 * (end - between))
            if number % 50 == 49:
                health.report()
                report_ms.append(1e3 * (time.thread_time() - end))
        ratios = [np.percentile(health_ms, p) / np.percentile(baseline_ms, p) for p in (50, 99)]
        print(f"  {name:<16} baseline {figures(baseline_ms)}; health {figures(health_ms)}")
        print(
            f"  {'':<16} health to baseline: p50 {ratios[0]:.2f}  p99 {ratios[1]:.2f}; report, once a second: ", end=""
        )
        print(f"{np.median(report_ms):.1f} (most {max(report_ms):.1f})", flush=True)


def found() -> None:
    """What planted faults are called, by their size."""
    print(f"{PLATES * len(SEEDS)} plates of 64 taxels, stroked 50 times; one such taxel on each")
    for gain in (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5):
        print(f"  gain {gain:<4}: {called('gain', gain)}", flush=True)
    for factor in (2.0, 3.0, 4.0, 5.0, 6.0, 8.0):
        print(f"  noise x {factor:g}: {called('noise', factor)}", flush=True)


def called(what: str, size: float) -> str:
    """Share of the planted taxels that are called each kind; and of the others that have a fault."""
    kinds: list[npt.NDArray[np.uint8]] = []
    false = 0
    for seed in SEEDS:
        world, taxels = plates(seed), chosen(seed)[:, 0]
        if what == "gain":
            world.gain[taxels] = size
        else:
            world.noisy(taxels, size)
        report = judged(world, QUICK)
        kinds.append(report.kind[taxels])
        false += int(np.delete(report.faulty, taxels).sum())
    counts = np.bincount(np.concatenate(kinds), minlength=len(HealthKind)).tolist()
    shares = [f"{100 * counts[kind] / sum(counts):.0f} % {kind.name.lower()}" for kind in HealthKind if counts[kind]]
    return f"{', '.join(shares)}; {false} of {(63 * PLATES) * len(SEEDS)} others have a fault"


if __name__ == "__main__":
    speed()
    found()
