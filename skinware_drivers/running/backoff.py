"""Pauses before attempts at something that fails."""

from __future__ import annotations


class Backoff:
    """Longer and longer pauses.

    Args:
        first_s: the first one; the next is twice as long, and so on.
        longest_s: the longest.
        at_once: no pause at all comes first.
    """

    def __init__(self, first_s: float, longest_s: float, *, at_once: bool = False) -> None:
        self._first_s = first_s
        self._longest_s = longest_s
        self._begin_s = 0.0 if at_once else first_s
        self._next_s = self._begin_s

    @property
    def longest_s(self) -> float:
        """The longest pause. What went well for that long is over: see ``begin_again``."""
        return self._longest_s

    def next_s(self) -> float:
        pause_s, self._next_s = self._next_s, min(2 * self._next_s or self._first_s, self._longest_s)
        return pause_s

    def begin_again(self) -> None:
        self._next_s = self._begin_s
