"""LinkerHand's own SDK asks emulated hands for their matrices over CAN: what it shows is what our driver shows."""

from __future__ import annotations

import random
import sys
import threading
import time
from typing import Any, Literal

import can
from comparing import Comparison, emulated
from linkerbot.hand.l6 import L6
from linkerbot.hand.l20lite import L20lite
from linkerbot.hand.l25 import L25
from linkerbot.hand.o6 import O6

from skinware_drivers.can.linkerhand import LinkerHandDriver, LinkerHandOptions
from skinware_drivers.testing.vectors import decode_frames

HAND = 0x27
APART_S = 0.00013
"""From one frame to the next at 1 Mbit/s; the driver takes a matrix whose rows come within 8 ms."""
PRESS_S = 1.5
"""Then the emulated press is on the hand."""
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
HANDS: dict[str, tuple[type[Any], Literal["12x6", "10x4"]]] = {
    "L6": (L6, "12x6"),
    "L20lite": (L20lite, "12x6"),
    "L25": (L25, "12x6"),
    "O6": (O6, "10x4"),
}


class Listener:
    """All frames of a bus."""

    def __init__(self, group: str) -> None:
        self._bus = can.Bus(interface="udp_multicast", channel=group)
        self._ended = threading.Event()
        self.frames: list[tuple[int, bytes]] = []
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while (message := self._bus.recv(0.1)) or not self._ended.is_set():
            if message:
                self.frames.append((message.arbitration_id, bytes(message.data)))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.shutdown()


def compare(comparison: Comparison, name: str) -> None:
    make, touch = HANDS[name]
    group = f"239.74.163.{random.randint(20, 250)}"
    with emulated("linkerhand", f"udp_multicast:{group}", "--touch", touch, "--program-ms", "0", "--seed", "1"):
        hand = make(side="right", interface_name=group, interface_type="udp_multicast")
        try:
            hand.stop_polling()
            time.sleep(PRESS_S)
            listener = Listener(group)
            try:
                shown = hand.force_sensor.get_blocking(timeout_ms=3000)
            finally:
                listener.close()
        finally:
            hand.close()
    theirs = [value for finger in FINGERS for value in getattr(shown, finger).values.ravel().tolist()]
    driver, asking = (LinkerHandDriver(LinkerHandOptions(hands=(HAND,), touch=touch, ask=ask)) for ask in (False, True))
    questions = [poll.payload for poll in asking.polls]
    touches = [frame for frame in listener.frames if frame[0] == HAND and 0xB1 <= frame[1][0] <= 0xB5]
    asked = [payload for _, payload in touches if len(payload) == 2]
    if questions[0] in asked:  # the program also polls when it begins
        touches = touches[max(at for at, frame in enumerate(touches) if frame[1] == questions[0]) :]
    ours = decode_frames(driver, touches, strict=False, apart_s=APART_S).values.tolist()
    comparison.agree(f"{name}: {len(theirs)} taxels, {len(set(theirs))} different values", ours, theirs)
    comparison.agree(f"{name}: questions", questions, [payload for _, payload in touches if len(payload) == 2])
    exchange = [[identifier, payload.hex()] for identifier, payload in touches]
    comparison.keep(
        f"linkerhand_{name.lower()}", options={"hands": [HAND], "touch": touch}, frames=exchange, values=theirs
    )


if __name__ == "__main__":
    comparison = Comparison(sys.argv[1])
    for each in HANDS:
        compare(comparison, each)
    comparison.end()
