"""The other end of a bridge: a robot's services appear here, as they are there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import msgspec

from skinware.bridge.clock import PeerClock
from skinware.bridge.following import Follower, Traffic
from skinware.bridge.link import Link, Priority
from skinware.bridge.messages import Answered, Keys, Service, Services, Wish, read_text
from skinware.bridge.mirror import Mirror
from skinware.bridge.peer import ANSWER_S, Peer, Turns
from skinware.bridge_state import BridgeState, BridgeStateWriter, ServiceState
from skinware.errors import BridgeError, SkinwareError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns, short_turns
from skinware.service import Request

_TICK_S = 0.02
_SERVICES_NS = NS_PER_S
"""Between two questions for all services: what is told unasked may not arrive."""
_CALL_S = 30.0


class Joiner:
    """Publishes the services of a robot in a namespace of this machine, until it is stopped.

    Args:
        robot: its name.
        link: to it.
        namespace: where its services appear.
        mode: ``push`` or ``pull``; None: it finds out for each service.
        wish: some sensors that are wanted, and no services but drivers; None: all there is.
        why_not: why nobody is reached, a line for people, empty if somebody is; called in a thread, may wait.
        tell: is told what happens, as JSON has it.
    """

    def __init__(
        self,
        robot: str,
        link: Link,
        namespace: Namespace,
        *,
        mode: str | None = None,
        wish: Wish | None = None,
        why_not: Callable[[], str] = str,
        tell: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        self._mode, self._wish, self._namespace = mode, wish, namespace
        self._missing = ""  # of the wish, when it was asked for last
        self._tell = tell
        self._turns = Turns()
        self._mirror = Mirror(namespace, self._pass_on, lambda: self.clock.offset_ns(now_ns()))
        self._lock = self._mirror.lock
        self._followers: dict[str, Follower] = {}
        self._callers: tuple[str, ...] = ()
        self._stopping = False
        self._next_services_ns = self._next_state_ns = 0
        self._state_writer: BridgeStateWriter | None = None
        self._mirror.watch(self._turns.fd, self._turns.take)
        self._peer = Peer(robot, link, self._turns, self, why_not=why_not, tell=tell)
        self._of_any = Keys(robot)
        link.listen(self._of_any.services, self._heard_services)
        self._state = BridgeState(robot, False, self._peer.since_ns, None, None, 0, {})

    @property
    def is_connected(self) -> bool:
        """Whether the robot's bridge is heard."""
        return self._peer.is_connected

    @property
    def clock(self) -> PeerClock:
        """Of the robot."""
        return self._peer.clock

    def run(self, tell: Callable[[BridgeState], object] = lambda _: None) -> None:
        """Until ``stop``; ``tell`` is told once a second how the bridge is."""
        self._next_state_ns = now_ns() + NS_PER_S
        with short_turns():
            while not self._stopping:
                self._mirror.answer(_TICK_S)
                with self._lock:
                    self._look()
                if now_ns() >= self._next_state_ns:
                    self._next_state_ns = max(self._next_state_ns + NS_PER_S, now_ns())
                    with self._lock:
                        self._mirror.tidy()
                        self._publish_state(self._services_state())
                    tell(self._state)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True
        self._turns.ring()

    def close(self) -> None:
        """Withdraw all that is published."""
        with self._lock:
            for follower in self._followers.values():
                follower.is_over = True
            self._mirror.close()
            if self._state_writer is not None:
                self._state_writer.close()
                self._state_writer = None
        self._turns.close()

    def _look(self) -> None:
        time_ns = now_ns()
        if time_ns >= self._next_services_ns:
            self._ask_services()
        self._peer.look(time_ns)
        for follower in self._followers.values():
            follower.look(time_ns)
        if self._peer.since_ns != self._state.since_ns:
            state = "live" if self.is_connected else "unheard"
            self._publish_state({name: replace(one, state=state) for name, one in self._state.services.items()})

    # -- what is told of this bridge ------------------------------------------------------------------------------

    def _services_state(self) -> dict[str, ServiceState]:
        """How every service comes, since the last call."""
        states = {}
        for name, follower in self._followers.items():
            traffic = follower.traffic
            follower.traffic = Traffic(lost=traffic.lost, lost_before=traffic.lost)
            states[name] = ServiceState(
                follower.state if self.is_connected else "unheard",
                follower.mode,
                traffic.frames,
                traffic.lost,
                traffic.bytes,
                _quantile(traffic.ages_ns, 0.5),
                _quantile(traffic.ages_ns, 0.99),
                traffic.lost - traffic.lost_before,
            )
        return states

    def _publish_state(self, services: dict[str, ServiceState]) -> None:
        clock = self.clock
        self._state = BridgeState(
            self._peer.robot,
            self.is_connected,
            self._peer.since_ns,
            clock.offset_ns(now_ns()) if clock.is_known else None,
            clock.error_ns if clock.is_known else None,
            clock.round_trip_ns,
            services,
            self._peer.instance,
            self._peer.host,
            self._peer.namesakes,
            self._peer.switches,
            self._peer.guard.count + self._turns.left_out,
            self._peer.guard.last,
        )
        try:
            if self._state_writer is None:
                self._state_writer = BridgeStateWriter(self._peer.robot, self._namespace)
            self._state_writer.publish(self._state, now_ns())
        except SkinwareError as error:
            self._state_writer = None
            self._peer.say_once("state", f"how this bridge is cannot be told: {error}")

    # -- what is told of the robot --------------------------------------------------------------------------------

    def appeared(self) -> None:
        """See :class:`skinware.bridge.peer.Watcher`."""
        self._ask_services()

    def moved(self) -> None:
        """Likewise."""
        for follower in self._followers.values():
            follower.subscribe()

    def restarted(self) -> None:
        """Likewise."""
        for follower in self._followers.values():
            follower.start_over()

    def lost(self) -> None:
        """Likewise."""
        for follower in self._followers.values():
            follower.lost()

    def clock_told(self) -> None:
        """Likewise."""
        for follower in self._followers.values():
            follower.clock_told()

    # -- services -------------------------------------------------------------------------------------------------

    def _ask_services(self) -> None:
        self._next_services_ns = now_ns() + _SERVICES_NS
        self._peer.ask(
            self._of_any.services,
            lambda payload, _: self._take_services(payload),
            timeout_s=ANSWER_S,
            priority=Priority.CALLS,
            payload=b"" if self._wish is None else msgspec.json.encode(self._wish),
        )

    def _heard_services(self, _key: str, payload: bytes) -> None:
        self._peer.soon("a list of services", lambda: self._services_changed(payload), len(payload))

    def _services_changed(self, payload: bytes) -> None:
        if self._wish is None:
            self._take_services(payload)
        else:
            self._ask_services()

    def _take_services(self, payload: bytes | None) -> None:
        if not payload:
            return
        try:
            told = read_text(payload, Services)
        except BridgeError as error:
            self._peer.guard.refuse("a list of services", str(error))
            return
        if not self._peer.follows(told):
            return
        self._callers = told.callers
        before, self._missing = self._missing, told.missing
        if told.missing and told.missing != before:
            self._tell({"event": "trouble", "about": "part", "why": f"robot {self._peer.robot}: {told.missing}"})
        for name, service in told.services.items():
            self._take_service(name, service)
        for name in [name for name in self._followers if name not in told.services]:
            self._take_service(name, Service(state="closed"))

    def _take_service(self, name: str, told: Service) -> None:
        follower = self._followers.get(name)
        if follower is None:
            if told.state == "closed":
                return
            follower = self._followers[name] = self._new_follower(name, told)
        follower.take(told)
        if follower.is_over:
            del self._followers[name]

    def _new_follower(self, name: str, told: Service) -> Follower:
        part = "" if self._wish is None else self._wish.number
        return Follower(name, told, self._peer, self._mirror, mode=self._mode, part=part)

    # -- requests -------------------------------------------------------------------------------------------------

    def _pass_on(self, name: str, request: Request) -> None:
        self._peer.ask(
            self._peer.keys.call(name, request.operation),
            lambda payload, _: self._take_answer(name, request, payload),
            timeout_s=_CALL_S,
            priority=Priority.CALLS,
            payload=msgspec.json.encode(request.arguments),
        )

    def _take_answer(self, name: str, request: Request, payload: bytes | None) -> None:
        robot = self._peer.robot
        if payload is None:
            only = f"; it lets only {', '.join(self._callers)} call" if self._callers else ""
            self._mirror.answered(name, request, Answered(error=f"no answer from robot {robot}{only}"), None)
            return
        try:
            answer = read_text(payload, Answered)
            result = read_text(bytes(answer.result), Any)
        except BridgeError as error:
            self._peer.guard.refuse("an answer to a call", str(error))
            why = f"robot {robot} gave an answer that cannot be read: {error}"
            self._mirror.answered(name, request, Answered(error=why), None)
            return
        self._peer.heard()
        self._mirror.answered(name, request, answer, result)


def _quantile(values: Sequence[int], share: float) -> float | None:
    return sorted(values)[int(share * len(values))] if values else None
