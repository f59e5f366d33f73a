"""A recorded Modbus wire as a tapped line, so that a listener follows it: also one over TCP."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import TYPE_CHECKING, Literal

from skinware_drivers.counters import FramerCounters
from skinware_drivers.modbus import wire

if TYPE_CHECKING:
    from skinware.recording import WireItem

_MANY = 50
"""Reads and writes that are looked at."""


def modbus_form(items: Iterable[WireItem]) -> Literal["rtu", "tcp"] | None:
    """How the questions of a recorded wire are written; None: it is no Modbus."""
    for item in islice(items, _MANY):
        line = wire.RtuMessages(FramerCounters())
        line.feed(item.data)
        asked = line.next_of(None)
        if asked is not None and wire.rtu_frame(asked) == item.data and wire.is_question(asked.data):
            return "rtu"
        if item.is_sent and _is_asked_over_tcp(item.data):
            return "tcp"
    return None


def as_on_a_line(items: Iterable[WireItem], form: Literal["rtu", "tcp"]) -> Iterator[WireItem]:
    """All that was said, questions and replies, as somebody hears it who taps the line."""
    messages = {is_sent: wire.TcpMessages(FramerCounters()) for is_sent in (False, True)}
    for item in items:
        data = item.data
        if form == "tcp":
            try:
                data = b"".join(map(wire.rtu_frame, messages[item.is_sent].feed(item.data)))
            except ValueError:  # it was lost then, too
                continue
        yield item._replace(is_sent=False, data=data)


def _is_asked_over_tcp(data: bytes) -> bool:
    try:
        asked = list(wire.TcpMessages(FramerCounters()).feed(data))
    except ValueError:
        return False
    return bool(asked) and wire.is_question(asked[0].data)


__all__ = ["as_on_a_line", "modbus_form"]
