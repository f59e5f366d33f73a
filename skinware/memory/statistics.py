"""Figures that everybody may see: how long things took, as extremes, means and histograms."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.memory import file_layout

BUCKETS = file_layout.HISTOGRAM_BUCKETS


def bucket_of(value_ns: int) -> int:
    """Return the bucket of a histogram that a time falls into."""
    return min(value_ns.bit_length(), BUCKETS - 1) if value_ns > 0 else 0


class Spread(msgspec.Struct):
    """How often something was timed, and how long it took; the extremes are 0 until it was."""

    count: int = 0
    best_ns: int = 0
    worst_ns: int = 0
    total_ns: int = 0

    @property
    def mean_ns(self) -> float:
        """Mean, 0 as long as ``count`` is."""
        return self.total_ns / self.count if self.count else 0.0

    def add(self, value_ns: int) -> None:
        if value_ns > self.worst_ns:
            self.worst_ns = value_ns
        if value_ns < self.best_ns or not self.count:
            self.best_ns = value_ns
        self.count += 1
        self.total_ns += value_ns


class Histogram(msgspec.Struct):
    """Times in buckets that double: bucket k counts 2**(k-1) to 2**k - 1 ns, the last one all above."""

    counts: list[int] = msgspec.field(default_factory=lambda: [0] * BUCKETS)

    @property
    def total(self) -> int:
        return sum(self.counts)

    def add(self, value_ns: int) -> None:
        self.counts[bucket_of(value_ns)] += 1

    def quantile_ns(self, fraction: float) -> int | None:
        """Return a bound that this fraction of the times does not exceed (up to twice the true one); None: no times."""
        wanted, seen = fraction * self.total, 0
        for bucket, count in enumerate(self.counts):
            seen += count
            if count and seen >= wanted:
                return (1 << bucket) - 1
        return None


class WriterStatistics(msgspec.Struct):
    """Figures that a writer counts in one generation of its service.

    Attributes:
        missed_periods: periods in which it published nothing because it was late.
        before_boot: samples whose ``acquired_ns`` lay before this machine booted, and counts as 0.
        ahead: samples whose ``acquired_ns`` lay more than 0.2 s in the future, so that nothing in them is fresh.
        wall: from ``begin`` to ``commit``.
        cpu: from one publication to the next, on a processor.
        age: how old the newest data of a sample was when it was published.
        lateness: how late its periods began (periodic writers).
    """

    published: int
    missed_periods: int
    before_boot: int
    ahead: int
    wall: Spread
    cpu: Spread
    age: Histogram
    lateness: Histogram


def read_statistics(data: npt.NDArray[np.uint8]) -> WriterStatistics:
    words = (
        data[file_layout.STATISTICS_OFFSET :][: file_layout.STATISTICS.itemsize].view(file_layout.STATISTICS)[0].copy()
    )
    control = data[file_layout.CONTROL_OFFSET :][: file_layout.CONTROL.itemsize].view(file_layout.CONTROL)[0]
    timed = int(words["timed"])

    def spread(what: str) -> Spread:
        return Spread(timed, *(int(words[f"{what}_{which}_ns"]) for which in ("best", "worst", "total")))

    return WriterStatistics(
        int(control["latest"]),
        int(control["missed_periods"]),
        int(words["before_boot"]),
        int(control["ahead"]),
        spread("wall"),
        spread("cpu"),
        Histogram(words["age"].tolist()),
        Histogram(words["lateness"].tolist()),
    )
