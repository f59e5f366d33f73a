"""Which identifiers a driver wants to hear at all, for a kernel that can leave out the others.

Compiled from the layout alone, not from what is attached to the bus: a patch that joins later has identifiers of the
layout, too. What handshakes wait for is added by the link for as long as they wait
(:class:`skinware_drivers.link.Link`), so no filter can hide an answer, whatever a driver asks.
"""

from __future__ import annotations

from collections.abc import Iterable

from skinware_drivers.bus import EXTENDED_FLAG, REMOTE_FLAG, Filter
from skinware_drivers.layout import Identifier, Layout

_FLAGS = EXTENDED_FLAG | REMOTE_FLAG


def filters_of(layout: Layout) -> list[Filter]:
    """What lets all frames of a layout through, as few as there can be; no remote frames."""
    found = []
    for frame in layout.frames:
        value, mask = (EXTENDED_FLAG if frame.extended else 0), _FLAGS
        conditions = [condition for condition in frame.when if isinstance(condition, Identifier)]
        for condition in conditions:
            value |= condition.value
            mask |= condition.mask
        if all(value & condition.mask == condition.value for condition in conditions):  # else nothing fulfils them all
            found.append(Filter(value, mask))
    return fewest(found)


def fewest(filters: Iterable[Filter]) -> list[Filter]:
    """Filters that let the same frames through as these, with none that others make needless."""
    left = {Filter(value & mask, mask) for value, mask in filters}
    while True:
        joined = {_join(one, other) for one in left for other in left if _differ_in_one_bit(one, other)}
        every = left | joined
        fewer = {one for one in every if not any(_covers(other, one) for other in every if other != one)}
        if fewer == left:
            return sorted(left)
        left = fewer


def _covers(wide: Filter, narrow: Filter) -> bool:
    return wide.mask & narrow.mask == wide.mask and narrow.value & wide.mask == wide.value


def _differ_in_one_bit(one: Filter, other: Filter) -> bool:
    return one.mask == other.mask and (one.value ^ other.value).bit_count() == 1


def _join(one: Filter, other: Filter) -> Filter:
    mask = one.mask & ~(one.value ^ other.value)
    return Filter(one.value & mask, mask)
