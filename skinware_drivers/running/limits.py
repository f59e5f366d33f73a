"""Warns once when a bus or this machine comes close to what it can carry."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import LOAD_FILTERED, LOAD_UNKNOWN
from skinware_drivers.bus import Bus

log: logging.Logger = logging.getLogger("skinware.driver")

HIGH_LOAD = 0.8
"""Of what the wire can carry. Beyond it, frames of low priority wait for long."""
FULL = 0.9
"""From here on they may wait indefinitely: how many bits a frame takes is an estimate."""
HIGH_FILL = 0.5
"""Of the receive buffer."""
SOFTNET = Path("/proc/net/softnet_stat")
_LOOK_PAUSE_NS = NS_PER_S
TROUBLESHOOTING = 'see "Troubleshooting" in the documentation'


def share_of_time(bus: Bus, bits: float, passed_ns: int) -> float | None:
    """Share of a wire's time that bits took, 0 to 1; None where its bit rate is not known.

    Args:
        bus: the bus.
        bits: of its bit rate, as ``wire_bits`` counts them.
        passed_ns: in what time, more than 0.
    """
    return bits * NS_PER_S / (bus.bit_rate * passed_ns) if bus.bit_rate else None


class BusLimits:
    """Compares one bus with its limits once a second.

    Args:
        name: of the bus, for people.
        bus: the bus.
        clock: CLOCK_MONOTONIC ns.

    Attributes:
        load: share of the wire's time in use, over the last second; None where that is not known.
        load_from_ns: when that second began.
    """

    def __init__(self, name: str, bus: Bus, clock: Callable[[], int] = now_ns) -> None:
        self._name = name
        self._bus = bus
        self._clock = clock
        self._looked_ns = clock()
        self._bits = bus.wire_bits
        self._lost = bus.counters.lost
        self._told: set[str] = set()
        self.load: float | None = None
        self.load_from_ns = 0

    def look(self) -> None:
        time_ns = self._clock()
        passed_ns = time_ns - self._looked_ns
        if passed_ns < _LOOK_PAUSE_NS:
            return
        bus, self.load_from_ns, self._looked_ns = self._bus, self._looked_ns, time_ns
        bits, self._bits = bus.wire_bits - self._bits, bus.wire_bits
        self.load = share_of_time(bus, bits, passed_ns)
        fill, bus.fullest = bus.fullest, 0.0
        if self.load is not None and self.load > HIGH_LOAD:
            self._tell("load", f"about {self.load:.0%} of its time is in use: frames with low priority wait")
        if fill > HIGH_FILL:
            self._tell("fill", f"the receive buffer was {fill:.0%} full: this driver gets too little processor time")
        if bus.counters.lost > self._lost:
            lost = bus.counters.lost - self._lost
            self._tell("lost", f"{lost} frames were lost: the receive buffer was full (or the adapter's queue)")

    @property
    def is_full(self) -> bool:
        """Whether frames of low priority may find no room at all."""
        return self.load is not None and self.load > FULL

    def knows_load_since(self, time_ns: int) -> bool:
        """Whether the load is that of a time after this, as far as it will ever be known."""
        return not self._bus.bit_rate or self.load_from_ns >= time_ns

    @property
    def permille(self) -> int:
        """The load in thousandths, at least 1; or why it is not known, as in :mod:`skinware.status`."""
        if self.load is None:
            return LOAD_FILTERED if self._bus.narrows else LOAD_UNKNOWN
        return max(1, round(1000 * self.load))

    def _tell(self, what: str, text: str) -> None:
        if what not in self._told:
            self._told.add(what)
            log.warning("bus %s: %s; logged once, %s", self._name, text, TROUBLESHOOTING)


class MachineLimits:
    """What this machine as a whole lost: no socket and no bus knows of it.

    Packets of *all* network interfaces wait for a processor in a queue (``net.core.netdev_max_backlog``) before they
    reach sockets; CAN frames too. What does not fit is only counted in /proc/net/softnet_stat, for the machine.

    Args:
        source: the file to read.
        clock: CLOCK_MONOTONIC ns.

    Attributes:
        softnet_dropped: packets dropped there since this object was made.
    """

    def __init__(self, source: Path = SOFTNET, clock: Callable[[], int] = now_ns) -> None:
        self._source = source
        self._clock = clock
        self._looked_ns = clock()
        self._before = self._read()
        self.softnet_dropped: int = 0

    def look(self) -> None:
        """Read the file, if the last look was a second ago."""
        time_ns = self._clock()
        if time_ns - self._looked_ns < _LOOK_PAUSE_NS:
            return
        self._looked_ns = time_ns
        was_none = not self.softnet_dropped
        self.softnet_dropped = max(self.softnet_dropped, self._read() - self._before)
        if was_none and self.softnet_dropped:
            log.warning(
                "this machine dropped %d network packets before any socket saw them, CAN frames perhaps among them;"
                " more room: sysctl net.core.netdev_max_backlog=10000; logged once, %s",
                self.softnet_dropped,
                TROUBLESHOOTING,
            )

    def _read(self) -> int:
        return softnet_dropped(self._source) or 0


def softnet_dropped(source: Path = SOFTNET) -> int | None:
    """Packets that this machine has dropped before any socket saw them; None where the kernel does not tell."""
    try:
        return sum(int(row.split()[1], 16) for row in source.read_text().splitlines())
    except (OSError, ValueError, IndexError):  # no such file, or of another form
        return None
