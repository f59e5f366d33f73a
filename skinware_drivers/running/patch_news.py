"""Tells which patches of a bus fell silent or are live again: many in one line, and of one that flaps now and then."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.running.bus_news import Allowance

log: logging.Logger = logging.getLogger("skinware.driver")

_SETTLED_NS, _LONGEST_NS = NS_PER_S // 5, NS_PER_S
"""What changes within a moment of the change before is told with it, at the latest after a second."""
_MOST_NAMES = 6


class PatchChange(NamedTuple):
    """What changed on a bus since it was last told.

    Attributes:
        bus: its name.
        silent: names of the patches that fell silent.
        live: names of those that are live again, if only after a moment.
    """

    bus: str
    silent: Sequence[str]
    live: Sequence[str]

    def __str__(self) -> str:
        parts = []
        if self.silent:
            parts.append(f"{_who(self.silent)} fell silent{_names(self.silent)}")
        if self.live:
            parts.append(f"{_who(self.live)} {'is' if len(self.live) == 1 else 'are'} live again{_names(self.live)}")
        return f"{self.bus}: {'; '.join(parts)}"


class PatchNews:
    """What is told of the patches of one bus, with the limit that the news of a bus have.

    Args:
        bus: its name.
        clock: CLOCK_MONOTONIC ns.
    """

    def __init__(self, bus: str, clock: Callable[[], int] = now_ns) -> None:
        self._bus = bus
        self._clock = clock
        self._allowance = Allowance(clock)
        self._is_live: dict[str, bool] = {}  # of patches that changed since it was last told
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
        """Tell what has changed, if its time has come; to be called now and then. What was told."""
        if not self._changes:
            return None
        settled_ns = min(self._last_ns + _SETTLED_NS, self._first_ns + _LONGEST_NS)
        if self._clock() < settled_ns or not self._allowance.take():
            return None
        by_state = {state: [name for name, now in self._is_live.items() if now is state] for state in (False, True)}
        change = PatchChange(self._bus, by_state[False], by_state[True])
        untold = self._changes - len(self._is_live)
        log.warning("%s%s", change, f" (changes not told before: {untold})" if untold else "")
        self._is_live, self._changes = {}, 0
        return change


def _who(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} patches"


def _names(names: Sequence[str]) -> str:
    if len(names) == 1:
        return ""
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f" ({', '.join(names[:_MOST_NAMES])}{more})"
