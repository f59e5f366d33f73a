"""AnySkin's and ReSkin's own libraries as readers of an emulated board: the same bytes are the same values."""

from __future__ import annotations

import sys
import tempfile
from typing import Any

import numpy as np
from comparing import Comparison, emulated, tapped

from skinware_drivers.serial.anyskin import AnySkinDriver, AnySkinOptions
from skinware_drivers.testing.vectors import decode_stream

MAGNETOMETERS, SAMPLES = 5, 400
MESSAGE = 16 * MAGNETOMETERS + 2
KEPT = 3


def read(library: str, port: str) -> list[list[float]]:
    """Samples as the library has them."""
    if library == "anyskin":
        from anyskin import AnySkinBase

        board: Any = AnySkinBase(num_mags=MAGNETOMETERS, port=port, temp_filtered=False)
        return [sample[1:].tolist() for sample in board.get_data(SAMPLES)]
    from reskin_sensor import ReSkinBase

    board = ReSkinBase(num_mags=MAGNETOMETERS, port=port)
    return [sample.data.tolist() for sample in board.get_data(SAMPLES)]


def ours(stream: bytes) -> list[list[float]]:
    """Return what our driver shows after each message; one is taken when the next one ends as it must, too."""
    driver = AnySkinDriver(AnySkinOptions(mags=MAGNETOMETERS))
    shown = [
        decode_stream(driver, stream[at : at + 2 * MESSAGE], strict=False)
        for at in range(0, len(stream) - 2 * MESSAGE + 1, MESSAGE)
    ]
    return [np.asarray(each.values, float).tolist() for each in shown]


def compare(library: str, package: str) -> Comparison:
    comparison = Comparison(package)
    with tempfile.TemporaryDirectory() as folder:
        port = f"{folder}/board"
        with emulated("anyskin", f"pty:{port}", "--mags", str(MAGNETOMETERS)), tapped(port) as (copy, heard):
            theirs = read(library, copy)
        stream = bytes(heard[heard.index(b"\r\n") + 2 :]) if heard[80:82] != b"\r\n" else bytes(heard)
    decoded = ours(stream)
    at = next((at for at in range(len(decoded)) if decoded[at : at + SAMPLES] == theirs), 0)
    different = len({tuple(sample) for sample in theirs})
    what = f"{SAMPLES} samples of {MAGNETOMETERS} magnetometers, {different} different ones"
    comparison.agree(what, decoded[at : at + SAMPLES], theirs)
    nth = max(range(SAMPLES - KEPT), key=lambda sample: len(set(theirs[sample])))
    kept = stream[(at + nth) * MESSAGE : (at + nth + KEPT + 1) * MESSAGE]
    values = theirs[nth : nth + KEPT]
    comparison.keep(library, options={"mags": MAGNETOMETERS}, stream=kept.hex(), values=values)
    return comparison


if __name__ == "__main__":
    compare(*sys.argv[1:3]).end()
