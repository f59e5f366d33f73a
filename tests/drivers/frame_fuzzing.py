"""Random frames through a driver's layout, in numpy and in C: nothing raises, and both do the same.

What ``tools/fuzz frames`` does for long and the tests for a moment. Frames are whole cycles, frames of one kind with
arbitrary values, and frames of which identifier, length or constant bytes are wrong; in any order, with any stamps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import wire_dtype
from skinware_drivers.description import assemble
from skinware_drivers.fields import Bits, Byte, Identifier
from skinware_drivers.layout import Frame
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.one_path import Publishing

_ROWS = 512
_RIGHT, _WHOLE, _IN_ORDER = 0.9, 0.3, 0.5
_STEPS_NS = np.array([130_000, 130_000, 130_000, 130_000, 0, 2_000_000, 60_000_000, -500_000])


class Outcome(NamedTuple):
    """What came of it.

    Attributes:
        fed: bytes of payloads.
        updates: of modules, whole.
        counted: frames that were counted as wrong or unknown, or that found no partners.
    """

    fed: int
    updates: int
    counted: int


def fuzz(adapter: AnyAdapter, n_bytes: int, seed: int) -> Outcome:
    """Feed so many bytes of payloads.

    Args:
        adapter: whose patches and layout are known.
        n_bytes: at least.
        seed: of what is random.
    """
    tables = assemble([("bus", adapter.patches)], adapter.types, adapter.dtype)
    random, fed = np.random.default_rng(seed), 0
    publishing = Publishing(adapter.period_s)
    with (
        hand_clock() as clock,
        Pair(
            clock,
            [adapter.layout],
            tables,
            [adapter.period_s],
            publishing,
            rows=4 * _ROWS,
            watch=adapter.watch,
            payload_size=adapter.payload_size,
        ) as pair,
    ):
        time_ns = clock.now_ns
        while fed < n_bytes:
            wire, in_order = _frames(adapter, random)
            steps = np.where(in_order, _STEPS_NS[0], random.choice(_STEPS_NS, len(wire)))
            stamps = time_ns + np.cumsum(steps)
            time_ns = max(time_ns, int(stamps.max()))
            pair.pass_to(time_ns)
            pair.feed_rows(wire, stamps)
            fed += int(wire["length"].sum())
        state = pair.numpy.decoder.state
        wrong = int(state.bus_counters[:, :3].sum() + state.patch_counters[:, 1].sum())
        return Outcome(fed, int(state.patch_counters[:, 0].sum()), wrong)


def _frames(adapter: AnyAdapter, random: np.random.Generator) -> tuple[npt.NDArray[np.void], npt.NDArray[np.bool_]]:
    """Some hundred frames; and which of them come right behind those before them, and are as they should be."""
    layout = adapter.layout
    kinds = {frame.name: frame for frame in layout.frames}
    cycles = [[kinds[name] for name in cycle.members] for cycle in layout.cycles]
    chosen: list[tuple[Frame, int, bool]] = []
    while len(chosen) < _ROWS:
        key = int(random.integers(8))
        if cycles and random.random() < _WHOLE:
            is_right = bool(random.random() < _IN_ORDER)
            chosen += [(frame, key, is_right) for frame in cycles[key % len(cycles)]]
        else:
            chosen.append((layout.frames[int(random.integers(len(layout.frames)))], key, False))
    wire = np.zeros(len(chosen), wire_dtype(adapter.payload_size))
    for row, (frame, key, is_right) in zip(wire, chosen, strict=True):
        _fill(row, frame, adapter, key, 1.0 if is_right else _RIGHT, random)
    return wire, np.array([is_right for _, _, is_right in chosen])


def _fill(row: np.void, frame: Frame, adapter: AnyAdapter, key: int, right: float, random: np.random.Generator) -> None:
    """Make a frame of a kind; each part of it is right with this probability."""
    patch = adapter.patches[key % len(adapter.patches)]
    module = patch.modules[key % len(patch.modules)]
    row["payload"] = random.integers(0, 256, row["payload"].shape, np.uint8)
    row["length"] = (
        random.choice(frame.length) if random.random() < right else random.integers(adapter.payload_size + 1)
    )
    row["identifier"] = random.integers(0x800)
    if random.random() < right:
        row["identifier"] = 0
        for condition in frame.when:
            if isinstance(condition, Identifier):
                row["identifier"] = condition.value
            elif isinstance(condition, Byte):
                row["payload"][condition.offset] &= 0xFF ^ condition.mask
                row["payload"][condition.offset] |= condition.value
        for field, number in ((frame.patch, patch.key), (frame.module, module.key)):
            if isinstance(field, Bits) and field.byte is not None:
                row["payload"][field.byte] = number << field.shift & 0xFF
            elif isinstance(field, Bits):
                row["identifier"] |= number << field.shift & 0x7FF
