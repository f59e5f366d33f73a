"""The package ``flexitac`` as the reader of an emulated pad: the same bytes are the same cells."""

from __future__ import annotations

import sys
import tempfile

from comparing import Comparison, emulated, tapped
from flexitac import FlexiTacSensor

from skinware_drivers.serial.flexitac import FlexiTacDriver, FlexiTacOptions
from skinware_drivers.testing.vectors import decode_stream
from skinware_drivers.virtual.devices.flexitac import EmulatedFlexiTac, EmulatedFlexiTacOptions

ROWS, COLUMNS, SAMPLES = 12, 32, 200
MARKER = b"\xaa\x55"
FRAME = len(MARKER) + ROWS * COLUMNS


def ours(stream: bytes) -> list[list[int]]:
    """Return what our driver shows after each frame; it first listens to an emulated pad of the same size."""
    driver, like = FlexiTacDriver(FlexiTacOptions()), EmulatedFlexiTacOptions(rows=ROWS, columns=COLUMNS)
    decode_stream(driver, b"", strict=False, devices=EmulatedFlexiTac(like))
    ends = range(FRAME + len(MARKER), len(stream), FRAME)
    frames = [stream[end - FRAME - len(MARKER) : end] for end in ends]
    return [
        decode_stream(driver, each, strict=False, devices=EmulatedFlexiTac(like)).values.tolist() for each in frames
    ]


def main() -> None:
    comparison = Comparison(sys.argv[1])
    size = ("--rows", str(ROWS), "--columns", str(COLUMNS))
    with tempfile.TemporaryDirectory() as folder:
        port = f"{folder}/pad"
        with emulated("flexitac", f"pty:{port}", *size), tapped(port) as (copy, heard):
            with FlexiTacSensor(copy, rows=ROWS, cols=COLUMNS, baseline=0.0) as pad:
                theirs = [pad.read().raw.ravel().tolist() for _ in range(SAMPLES)]
    decoded = iter(ours(bytes(heard[heard.index(MARKER) :])))  # it skips some: it keeps at most 50,000 bytes
    shown = [each for each in theirs if each in decoded]
    different = len({tuple(sample) for sample in theirs})
    what = f"{SAMPLES} frames of {ROWS} x {COLUMNS} cells, {different} different ones"
    comparison.agree(what, shown, theirs)
    comparison.end()


if __name__ == "__main__":
    main()
