"""paxini-sdk reads emulated boards: a sensor behind a converter board, and a high-speed board that streams."""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np
from comparing import Comparison, emulated, heard_by_pyserial
from paxini_sdk import HighSpeedHandBoard, SingleSensorBoard
from paxini_sdk.protocol import split_force_xyz

from skinware_drivers.testing.vectors import decode_stream
from tests.peers.paxini_boards import POINTS, SENSOR, SLOTS, known, messages

SAMPLES, KEPT = 400, 3
_FROM, _TAXELS_AT = 0x03F0, 30


def asked(port: str) -> list[list[int]]:
    """Taxels and resultant of a sensor, as the program takes them from one reply."""
    shown = []
    with SingleSensorBoard(port, device_id=SENSOR, n_points=POINTS) as board:
        for _ in range(SAMPLES):
            data = board._read(_FROM, _TAXELS_AT + 3 * POINTS)
            places = [*range(_TAXELS_AT, len(data), 3), 0]
            shown.append([axis for place in places for axis in split_force_xyz(data[place : place + 3])])
    return shown


def streamed(port: str) -> list[list[int]]:
    with HighSpeedHandBoard(port) as board:
        frames = list(board.stream_auto_push(max_frames=SAMPLES))
    return [
        [
            axis
            for name, taxels in frame.distributed_forces.items()
            for force in (*taxels, frame.resultant_forces[name])
            for axis in force
        ]
        for frame in frames
    ]


def compare(comparison: Comparison, name: str, read: Any, *options: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        port = f"{folder}/board"
        with emulated("paxini", f"pty:{port}", *options), heard_by_pyserial() as heard:
            theirs = read(port)
    frames = messages(bytes(heard))
    decoded = [(frame, decode_stream(known(name), frame, strict=False)) for frame in frames]
    whole = iter([(frame, shown.values.tolist()) for frame, shown in decoded if not shown.never_seen.any()])
    missing: tuple[bytes, list[int]] = (b"", [])
    ours = [next((each for each in whole if each[1] == values), missing) for values in theirs]  # it may miss some
    comparison.agree(f"{name}: {SAMPLES} times {len(theirs[0])} values", [values for _, values in ours], theirs)
    nth = int(np.argmax([len(set(values)) for values in theirs[: SAMPLES - KEPT]]))
    kept = [frame.hex() for frame, _ in ours[nth : nth + KEPT]]
    comparison.keep(f"paxini_{name}", frames=kept, values=theirs[nth : nth + KEPT])


def main() -> None:
    comparison = Comparison("paxini-sdk")
    compare(comparison, "converter", asked, "--points", str(POINTS))
    slots = ",".join(map(str, SLOTS))
    compare(comparison, "high_speed", streamed, "--board", "high_speed", "--slots", slots, "--points", str(POINTS))
    comparison.end()


if __name__ == "__main__":
    main()
