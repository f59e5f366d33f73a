"""Make the world in which rules for baselines are compared: 25 minutes of drift and of all kinds of touches."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware.tactile.testing import Response, World, grid

BENCH_S = 1500.0
"""How long it lasts, s."""
_DRIFT_PER_MIN = {"slow": 0.5, "fast": 3.0}
_TAXELS = 12


def bench_world(
    drift: Literal["slow", "fast"] = "slow",
    rate_hz: float = 50.0,
    seed: int = 1,
    *,
    patches: int = 1,
    dtype: npt.DTypeLike = np.uint8,
) -> World:
    """Make 120 taxels in 10 modules of 12, 8 bits, that drift together, each in its own degree, and press them.

    Each kind of gesture has a module of its own, and its name:

    ======== ============== ======================================================================================
    module   name           what happens
    ======== ============== ======================================================================================
    0        ``covered``    all its taxels bear 40 counts from before the start until second 60
    1        ``hold``       25 counts from second 120 to 720
    2        ``tap``        30 taps of 0.3 s with 30 counts, one each 20 s from second 100 on, on changing taxels
    3        ``slow``       12 counts, reached within 60 s from second 300 on, held for 60 s, let go in 1 s
    4        ``weak``       6 counts from second 800 to 1100
    5        ``firm``       60 counts for 60 s, from second 200 and 900 on: its neighbours sag by up to 12
    6        ``stroke``     20 counts along its rows, 3 s, each 30 s from second 90 on
    7 to 9                  never touched
    ======== ============== ======================================================================================

    After a release, 20 % of the load stays and fades with a time constant of 40 s.

    Args:
        drift: 0.5 or 3 counts per minute.
        rate_hz: of the frames.
        seed: of all that is random; the gestures do not depend on it.
        patches: number of patches; each has an equal share of the modules.
        dtype: of the values.
    """
    world = World(
        grid(modules=10, patches=patches),
        seed=seed,
        rate_hz=rate_hz,
        drift_per_min=_DRIFT_PER_MIN[drift],
        wave=1.0,
        response=Response(sag=0.2, remainder=0.2),
        dtype=dtype,
    )
    place = world.surface.position_m.reshape(10, _TAXELS, 3)
    world.cover(np.arange(_TAXELS), 40, -1, 60, name="covered")
    world.push(place[1, 5], 25, 120, 720, rise_s=0.2, name="hold")
    for number in range(30):
        begin_s = 100 + 20.0 * number
        world.push(place[2, 5 * number % _TAXELS], 30, begin_s, begin_s + 0.3, name="tap")
    world.push(place[3, 6], 12, 300, 421, rise_s=60, fall_s=1, name="slow")
    world.push(place[4, 5], 6, 800, 1100, rise_s=0.2, name="weak")
    for begin_s in (200.0, 900.0):
        world.push(place[5, 5], 60, begin_s, begin_s + 60, rise_s=0.2, name="firm")
    for number in range(40):
        begin_s, row = 90 + 30.0 * number, place[6].reshape(3, 4, 3)[number % 3]
        world.stroke(row[[0, -1]], 20, begin_s, begin_s + 3, rise_s=0.1, name="stroke")
    return world
