"""Parts of a robot's skin that somebody wants: some sensors of its drivers, for as long as they are asked for."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from skinware.bridge.cutting import Cut
from skinware.bridge.giving import Stream
from skinware.bridge.messages import Wish
from skinware.errors import BridgeError
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.structure import Structure
from skinware.tactile.choosing import SensorChoice
from skinware.transfer.generation import Generation

_KEPT_NS = 10 * NS_PER_S
"""How long a part is kept that nobody asks for."""
_MOST = 64


class Part:
    """Some sensors of the drivers of a robot.

    Args:
        choice: which.
        stream_of: makes what gives the frames of this part of a service.
    """

    def __init__(self, choice: SensorChoice, stream_of: Callable[[str], Stream]) -> None:
        self.choice, self._stream_of = choice, stream_of
        self._lock = threading.Lock()
        self._wholes: dict[str, Generation] = {}
        self._cuts: dict[str, Cut] = {}
        self._streams: dict[str, Stream] = {}

    def fit(self, name: str, whole: Generation) -> bool:
        """Go over to a generation of a driver; whether it has any of the sensors."""
        with self._lock:
            if self._wholes.get(name) is not whole:
                self._wholes[name] = whole
                self._cuts.pop(name, None)
                assert isinstance(whole.context, Structure)  # noqa: S101 - it is a driver
                wanted = np.flatnonzero(self.choice.of(name, whole.context))
                if len(wanted):
                    self._begin(name, Cut(whole, wanted))
            return name in self._cuts

    def take(self, name: str, frame: Sample) -> None:
        """Give what is of this part of a driver's frame, if it is of the generation that is known."""
        cut = self._cuts.get(name)
        if cut is not None and cut.generation.generation == frame.generation:
            self._streams[name].take(frame)

    def cut(self, name: str) -> Cut | None:
        """What there is of a driver."""
        return self._cuts.get(name)

    def stream(self, name: str) -> Stream | None:
        """What gives its frames."""
        return self._streams[name] if name in self._cuts else None

    def let_go(self) -> None:
        """Of questions that no frame comes for."""
        for stream in list(self._streams.values()):
            stream.let_go()

    def close(self) -> None:
        """Nothing is given any more."""
        with self._lock:
            self._cuts.clear()
            for stream in self._streams.values():
                stream.close()

    def _begin(self, name: str, cut: Cut) -> None:
        if name not in self._streams:
            self._streams[name] = self._stream_of(name)
        self._streams[name].begin(cut.generation.generation, cut.generation.coded, cut.frame)
        self._cuts[name] = cut


class Parts:
    """All parts that are wanted now.

    Args:
        stream_of: makes what gives the frames of a part: (service, number of the wish).
    """

    def __init__(self, stream_of: Callable[[str, str], Stream]) -> None:
        self._stream_of = stream_of
        self._lock = threading.Lock()
        self._parts: dict[str, Part] = {}
        self._asked_ns: dict[str, int] = {}

    def wanted(self, wish: Wish) -> Part:
        """The part of a wish, which is asked for now.

        Raises:
            BridgeError: there are too many others.
            ConfigurationError: the wish contradicts itself.
        """
        number = wish.number
        with self._lock:
            part = self._parts.get(number)
            if part is None:
                if len(self._parts) >= _MOST:
                    raise BridgeError(f"{_MOST} other parts of it are wanted already")
                part = Part(wish.choice(), lambda service: self._stream_of(service, number))
                self._parts[number] = part
            self._asked_ns[number] = now_ns()
            return part

    def find(self, number: str) -> Part | None:
        return self._parts.get(number)

    def take(self, name: str, frame: Sample) -> None:
        """Give what is of each part of a driver's frame."""
        for part in list(self._parts.values()):
            part.take(name, frame)

    def let_go(self) -> None:
        """Of parts that nobody wants any more, and of questions that no frame comes for."""
        time_ns = now_ns()
        with self._lock:
            over = [number for number, asked_ns in self._asked_ns.items() if time_ns - asked_ns > _KEPT_NS]
            for number in over:
                del self._asked_ns[number]
                self._parts.pop(number).close()
        for part in list(self._parts.values()):
            part.let_go()
