"""Log once what happens to buses and patches, and what comes close to a limit."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import LOAD_FILTERED, LOAD_UNKNOWN, BusReason
from skinware.structure import Structure
from skinware.text import plural
from skinware_drivers.bus import Bus

log: logging.Logger = logging.getLogger("skinware.driver")

LINES_AT_ONCE = 5
"""Lines about one bus before it has to be brief."""
LINE_EVERY_S = 10.0
"""Afterwards one line in this time, as long as the bus keeps changing."""

WORDS = {
    BusReason.NOTHING_HEARD: "nothing is heard any more",
    BusReason.BUS_OFF: "bus-off: the controller met too many errors and left the wire (short circuit, another bit"
    " rate?); it is back by itself if restart-ms is set, else after: ip link set INTERFACE type can restart",
    BusReason.ERROR_PASSIVE: "error-passive: many errors (bad wires, another bit rate, no other node on the wire?)",
    BusReason.ERROR_WARNING: "error-warning: more errors than there should be (termination, wires?)",
    BusReason.OVERFLOW: "the controller lost frames: this machine did not fetch them in time",
    BusReason.NO_ACKNOWLEDGEMENT: "no node acknowledges what is sent (wires, power, another bit rate?)",
    BusReason.BUS_ERRORS: "broken frames are heard (another bit rate, termination, wires; over a network, another"
    " program or version?)",
}
"""The meaning of each reason, for people; other reasons come with an error."""


def reason_text(reason: BusReason) -> str:
    """Return a reason's name as people write it: ``bus-off``."""
    return reason.name.lower().replace("_", "-")


class LineLimit:
    """Limits log lines: a few at once, then one in a while.

    Args:
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, clock: Callable[[], int] = now_ns) -> None:
        self._clock = clock
        self._interval_ns = round(LINE_EVERY_S * NS_PER_S)
        self._savings_ns = (LINES_AT_ONCE - 1) * self._interval_ns
        self._free_at_ns = clock() - self._savings_ns

    def take(self) -> bool:
        """Return whether a line may be logged now, and count it."""
        time_ns = self._clock()
        if time_ns < self._free_at_ns:
            return False
        self._free_at_ns = max(self._free_at_ns, time_ns - self._savings_ns) + self._interval_ns
        return True


class BusNews:
    """Logs the changes of one bus, with a limit.

    The last change of a burst is always logged, if only later, with the number of changes that were left out.

    Args:
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, clock: Callable[[], int] = now_ns) -> None:
        self._limit = LineLimit(clock)
        self._pending = ""
        self._left_out = 0

    def log(self, text: str) -> None:
        if self._pending:
            self._left_out += 1
        self._pending = text
        self.catch_up()

    def catch_up(self) -> None:
        """Log the pending change if the limit allows it; to be called regularly."""
        if not self._pending or not self._limit.take():
            return
        before = f" ({plural(self._left_out, 'earlier change')} not logged)" if self._left_out else ""
        log.warning("%s%s", self._pending, before)
        self._pending, self._left_out = "", 0


_SETTLED_NS, _LONGEST_NS = NS_PER_S // 5, NS_PER_S
"""Changes that follow each other within the first are logged together, at the latest after the second."""
_MOST_NAMES = 6


class PatchChange(NamedTuple):
    """The changes of a bus since its last log line.

    Attributes:
        silent: names of the patches that fell silent.
        live: names of the patches that are live again.
    """

    bus: str
    silent: Sequence[str]
    live: Sequence[str]

    def __str__(self) -> str:
        parts = [_changed(self.silent, "fell silent")] if self.silent else []
        if self.live:
            parts.append(_changed(self.live, f"{'is' if len(self.live) == 1 else 'are'} live again"))
        return f"{self.bus}: {'; '.join(parts)}"


def _changed(names: Sequence[str], how: str) -> str:
    if len(names) == 1:
        return f"{names[0]} {how}"
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"{len(names)} patches {how} ({', '.join(names[:_MOST_NAMES])}{more})"


class PatchNews:
    """Logs the changes of the patches of one bus, with the limit of :class:`BusNews`.

    Args:
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, bus: str, clock: Callable[[], int] = now_ns) -> None:
        self._bus = bus
        self._clock = clock
        self._limit = LineLimit(clock)
        self._is_live: dict[str, bool] = {}  # patches that changed since the last line
        self._changes = 0
        self._first_ns = self._last_ns = 0

    def note(self, patch: str, *, is_live: bool) -> None:
        """A patch fell silent, or is live again."""
        self._last_ns = self._clock()
        if not self._changes:
            self._first_ns = self._last_ns
        self._changes += 1
        self._is_live[patch] = is_live

    def catch_up(self) -> PatchChange | None:
        """Log and return the changes once they have settled; to be called regularly."""
        if not self._changes:
            return None
        settled_ns = min(self._last_ns + _SETTLED_NS, self._first_ns + _LONGEST_NS)
        if self._clock() < settled_ns or not self._limit.take():
            return None
        by_state = {state: [name for name, now in self._is_live.items() if now is state] for state in (False, True)}
        change = PatchChange(self._bus, by_state[False], by_state[True])
        left_out = self._changes - len(self._is_live)
        log.warning("%s%s", change, f" (changes not logged before: {left_out})" if left_out else "")
        self._is_live, self._changes = {}, 0
        return change


_WINDOW_NS = 2 * NS_PER_S
_STEADILY = 3
"""Windows in a row: what waited while a driver was held up comes in one."""
_MUCH = 1.6


class Doubles:
    """Compares how many updates each patch sends with how many its period allows.

    Single frames of two devices with one identifier look alike; their number gives them away.

    Args:
        period_ns: the driver's period, above 0.
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, structure: Structure, period_ns: int, clock: Callable[[], int] = now_ns) -> None:
        self._clock = clock
        periods_ns = np.where(structure.group_period_ns > 0, structure.group_period_ns, max(1, period_ns))
        self._due_per_ns = np.bincount(structure.group_patch, 1 / periods_ns, structure.n_patches)
        self._before = np.zeros(structure.n_patches, np.int64)
        self._before_ns = clock()
        self._windows = np.zeros(structure.n_patches, np.int64)

    def look(self, updates: npt.NDArray[np.int64]) -> list[tuple[int, float]]:
        """Compare the counts of the last window; may be called at any time.

        Args:
            updates: (n_patches,) int64, updates of each patch so far.

        Returns:
            (patch, how many times more than is due) of patches that are to be reported: each once.
        """
        time_ns = self._clock()
        passed_ns = time_ns - self._before_ns
        if passed_ns < _WINDOW_NS:
            return []
        ratio = (updates - self._before) / np.maximum(self._due_per_ns * passed_ns, 1)
        self._before, self._before_ns = updates.copy(), time_ns
        self._windows = np.where(self._windows < _STEADILY, (self._windows + 1) * (ratio > _MUCH), _STEADILY + 1)
        return [(patch, float(ratio[patch])) for patch in np.flatnonzero(self._windows == _STEADILY).tolist()]


HIGH_LOAD = 0.8
"""Share of the wire's time beyond which frames of low priority wait for long."""
FULL = 0.9
"""From here on they may wait indefinitely: how many bits a frame takes is an estimate."""
HIGH_FILL = 0.5
"""Share of the receive buffer."""
SOFTNET = Path("/proc/net/softnet_stat")
_LOOK_PAUSE_NS = NS_PER_S
TROUBLESHOOTING = 'see "Troubleshooting" in the documentation'


def share_of_time(bus: Bus, bits: float, passed_ns: int) -> float | None:
    """Share of a wire's time that bits took, 0 to 1; None where its bit rate is not known.

    Args:
        bits: of its bit rate, as ``wire_bits`` counts them.
        passed_ns: in what time, more than 0.
    """
    return bits * NS_PER_S / (bus.bit_rate * passed_ns) if bus.bit_rate else None


class BusLimits:
    """Compares one bus with its limits once a second.

    Args:
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
        self._dropped = bus.counters.dropped
        self._logged: set[str] = set()
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
            self._log_once("load", f"about {self.load:.0%} of its time is in use: frames with low priority wait")
        if fill > HIGH_FILL:
            self._log_once("fill", f"the receive buffer was {fill:.0%} full: this driver gets too little time")
        if bus.counters.dropped > self._dropped:
            dropped = bus.counters.dropped - self._dropped
            self._log_once(
                "dropped", f"{plural(dropped, 'frame')} dropped: the receive buffer was full (or the adapter's queue)"
            )

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

    def _log_once(self, what: str, text: str) -> None:
        if what not in self._logged:
            self._logged.add(what)
            log.warning("bus %s: %s; logged once, %s", self._name, text, TROUBLESHOOTING)


class MachineLimits:
    """Counts the packets that this machine dropped before any socket saw them.

    Packets of *all* network interfaces wait for a processor in a queue (``net.core.netdev_max_backlog``) before they
    reach sockets; CAN frames too. The kernel counts those that do not fit in /proc/net/softnet_stat.

    Args:
        clock: CLOCK_MONOTONIC ns.

    Attributes:
        softnet_dropped: packets dropped there since this object was made.
    """

    def __init__(self, source: Path = SOFTNET, clock: Callable[[], int] = now_ns) -> None:
        self._source = source
        self._clock = clock
        self._looked_ns = clock()
        self._before = softnet_dropped(source) or 0
        self.softnet_dropped: int = 0

    def look(self) -> None:
        """Read the file, if the last look was a second ago."""
        time_ns = self._clock()
        if time_ns - self._looked_ns < _LOOK_PAUSE_NS:
            return
        self._looked_ns = time_ns
        was_none = not self.softnet_dropped
        self.softnet_dropped = max(self.softnet_dropped, (softnet_dropped(self._source) or 0) - self._before)
        if was_none and self.softnet_dropped:
            log.warning(
                "this machine dropped %d network packets before any socket saw them, CAN frames perhaps among them;"
                " more room: sysctl net.core.netdev_max_backlog=10000; logged once, %s",
                self.softnet_dropped,
                TROUBLESHOOTING,
            )


def softnet_dropped(source: Path = SOFTNET) -> int | None:
    """Return the packets that this machine dropped before any socket saw them; None where the kernel does not say."""
    try:
        return sum(int(row.split()[1], 16) for row in source.read_text().splitlines())
    except (OSError, ValueError, IndexError):  # no such file, or of another form
        return None
