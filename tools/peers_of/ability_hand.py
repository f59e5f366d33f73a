"""PSYONIC's own client commands an emulated hand: what it shows of the touch is what our driver shows."""

from __future__ import annotations

import os
import tempfile
import time
from typing import Any

import numpy as np
from comparing import Comparison, emulated, heard_by_pyserial

from skinware_drivers.serial.ability_hand import AbilityHandDriver, AbilityHandOptions
from skinware_drivers.testing.vectors import decode_stream

ANSWERS = {0: 400, 1: 400}
"""By reply mode; mode 2 has no touch."""
KEPT = 3


def newtons(counts: int) -> float:
    """The maker's formula, for the counts of a sensor."""
    return 121591.0 / (33000.0 / (counts * (3.3 / 4096.0)) + 10000) + 0.878894 if counts else 0


def read(mode: int, port: str) -> tuple[list[list[float]], bytes]:
    """Forces as the client shows them, and the bytes that it read."""
    from ah_wrapper import AHSerialClient  # writes a configuration file and a log into its folder
    from ah_wrapper.observer import Observer

    shown: list[list[float]] = []

    class Watch(Observer):  # type: ignore[misc]
        def ignore(self, *_: Any) -> None:
            """Other values."""

        update_pos = update_vel = update_cur = update_hot_cold = ignore

        def update_fsr(self, fsr: list[float]) -> None:
            shown.append(fsr)

    with heard_by_pyserial() as heard:
        client = AHSerialClient(port=port, baud_rate=460800, reply_mode=mode, auto_start_threads=False)
        client.hand._first_fsr = False  # no zero point
        client.hand.add_observer(Watch())
        heard.clear()
        client.start_threads()
        while len(shown) < ANSWERS[mode]:
            time.sleep(0.01)
        client.close()
        return shown, bytes(heard)


def main() -> None:
    comparison = Comparison("ability-hand")
    with tempfile.TemporaryDirectory() as folder, emulated("ability_hand", f"pty:{folder}/hand"):
        os.chdir(folder)
        for mode, count in ANSWERS.items():
            theirs, stream = read(mode, f"{folder}/hand")
            answers = [b"~" + part + b"~" for part in stream.split(b"~") if part][: len(theirs)]
            ours = [
                [newtons(int(count)) for count in decode_stream(AbilityHandDriver(AbilityHandOptions()), answer).values]
                for answer in answers
            ]
            comparison.agree(f"mode {mode}: {len(theirs)} times 30 sensors", ours, theirs)
            nth = int(np.argmax([len(set(values)) for values in theirs[: count - KEPT]]))
            kept = slice(nth, nth + KEPT)
            comparison.keep("ability_hand", answers=[each.hex() for each in answers[kept]], values=theirs[kept])
    comparison.end()


if __name__ == "__main__":
    main()
