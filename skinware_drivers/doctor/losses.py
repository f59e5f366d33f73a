"""How a loss is told: how much while somebody looked, before, and in which hour of a recording."""

from __future__ import annotations

from typing import NamedTuple

from skinware.cli._format import age_text, count_text, plural
from skinware_drivers.doctor.evidence import Counted, Evidence

_MOST_HOURS = 3


class Told(NamedTuple):
    """A loss in words.

    Attributes:
        is_going_on: it grew while somebody looked, or in the recording.
        text: how much: ``3 frames in 3.0 s (12 since the driver was started)``.
        hours: the worst hours of a recording, as a part of a sentence; empty without.
    """

    is_going_on: bool
    text: str
    hours: str


def lost_text(counted: Counted, name: str, unit: str, evidence: Evidence) -> Told | None:
    """What is to be said of a counter; None if it is 0.

    Args:
        counted: of a bus or patch.
        name: of the counter.
        unit: what it counts, in the singular.
        evidence: that it is part of.
    """
    total, grown = counted.total.get(name, 0), counted.grown.get(name, 0)
    if not total and not grown:
        return None
    if not grown:
        before = "before the recording began" if not evidence.is_live else "since the driver was started"
        return Told(False, f"{plural(total, unit)} {before}, none in these {_span(evidence)}", "")
    text = f"{plural(grown, unit)} in {_span(evidence)}"
    if evidence.is_live and total > grown:
        text += f" ({count_text(total)} since the driver was started)"
    return Told(True, text, _hours(counted, name, evidence))


def _hours(counted: Counted, name: str, evidence: Evidence) -> str:
    of_hours = [(counts.get(name, 0), hour) for hour, counts in counted.hours]
    worst = sorted((one for one in of_hours if one[0]), reverse=True)[:_MOST_HOURS]
    if evidence.is_live or evidence.seconds < 3600 or not worst:
        return ""
    told = ", ".join(f"{count_text(count)} in hour {hour + 1}" for count, hour in worst)
    return f"; most: {told}"


def _span(evidence: Evidence) -> str:
    return age_text(evidence.seconds * 1e9)
