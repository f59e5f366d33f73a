"""When a robot counts as connected: at moments of our own, over no link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from skinware.bridge.clock import Exchange
from skinware.bridge.link import ZenohLink
from skinware.bridge.peer import Jobs, Peer
from skinware.realtime import NS_PER_S, now_ns

MS = NS_PER_S // 1000


class NoLink:
    """Takes questions, and answers none."""

    def watch_tokens(self, key: str, heard: Callable[[str, bool], None]) -> None:
        pass

    def ask(self, key: str, came: Callable[[bytes | None], None], **how: Any) -> None:
        pass


def test_a_robot_behind_a_delay_that_has_grown_stays_connected() -> None:
    jobs = Jobs()
    events: list[dict[str, Any]] = []
    peer = Peer("icub", cast(ZenohLink, NoLink()), jobs, lambda _: None, why_not=str, on_event=events.append)
    begun = now_ns()
    for number, round_trip_ms in enumerate([1] * 20 + [600] * 3):
        at_ns = begun + 500 * MS * number
        peer.clock.add(Exchange(at_ns, -round_trip_ms * MS // 2, round_trip_ms * MS // 2, round_trip_ms * MS))
    assert peer.clock.round_trip_ns == MS
    peer.heard()
    peer.look(begun + 1500 * MS)
    assert peer.is_connected
    peer.look(now_ns() + 1700 * MS)
    assert not peer.is_connected
    assert [event["event"] for event in events] == ["connected", "disconnected"]
    assert "no answer for 1." in events[1]["why"]
    jobs.close()
