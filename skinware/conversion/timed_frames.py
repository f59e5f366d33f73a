"""The frames of tables, one after the other, as readers of recordings get them."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from skinware.conversion.tables import COLUMNS, TIME, Table
from skinware.memory.file_layout import SLOT
from skinware.transfer.frames import RecordedSample, frame_of
from skinware.transfer.generation import Generation


class TimedFrame(NamedTuple):
    """A frame of a table.

    Attributes:
        time_ns: when it was published, on the axis of the recording.
        service: whose it is.
        generation: of it.
        frame: it.
    """

    time_ns: int
    service: str
    generation: Generation
    frame: RecordedSample


def timed_frames(tables: Sequence[Table]) -> Iterator[TimedFrame]:
    return heapq.merge(*map(_of_table, tables), key=lambda each: each.time_ns)


def _of_table(table: Table) -> Iterator[TimedFrame]:
    generations = {generation.generation: generation for generation in table.generations}
    origin = table.origin
    for block in table.blocks(table.arrays):
        slots = np.zeros((len(block[TIME]), origin.slot_stride), np.uint8)
        heads = slots[:, : SLOT.itemsize].view(SLOT)[:, 0]
        for name in ("sequence", "acquired_ns", "published_ns", "flags"):
            heads[name] = block[f"frames/{name}"]
        for name, (_, _, offset) in origin.columns.items():
            rows = block.get(COLUMNS + name)
            if rows is not None:
                data = np.frombuffer(rows.tobytes(), np.uint8).reshape(len(slots), -1)
                slots[:, offset : offset + data.shape[1]] = data
        numbers, times = block["frames/generation"].tolist(), block[TIME].tolist()
        for slot, number, time_ns in zip(slots, numbers, times, strict=True):
            generation = generations[number]
            yield TimedFrame(time_ns, table.service, generation, frame_of(generation, slot))
