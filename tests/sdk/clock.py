"""A clock that a test moves."""

from __future__ import annotations


class Clock:
    """CLOCK_MONOTONIC ns, when it is called."""

    def __init__(self) -> None:
        self.time_ns = 10**12

    def __call__(self) -> int:
        return self.time_ns

    def pass_s(self, duration_s: float) -> None:
        self.time_ns += round(duration_s * 1e9)
