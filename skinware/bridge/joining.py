"""The other end of a bridge: the services of a robot appear here, with the same names and states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import msgspec

from skinware.bridge.clock import PeerClock
from skinware.bridge.following import ServiceFollower
from skinware.bridge.link import Priority, ZenohLink
from skinware.bridge.messages import CallResult, Keys, Service, Services, Wish, read_text
from skinware.bridge.mirror import Mirror
from skinware.bridge.peer import SLOWEST_ANSWER_S, Change, Jobs, Peer
from skinware.bridge_state import BridgeState, BridgeStateWriter, ServiceState
from skinware.errors import BridgeError, SkinwareError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns, short_turns
from skinware.service import Request

_TICK_S = 0.02
_SERVICES_NS = NS_PER_S
"""Time between two questions for all services: a list that is sent without a question may get lost."""
_CALL_S = 30.0


class Joiner:
    """Publishes the services of a robot in a namespace of this machine.

    Args:
        mode: ``push`` or ``pull``; None: the mode of each service follows the link.
        wish: the sensors that are wanted, without services that are no drivers; None: all services.
        why_not: returns, in one line, the reason why nothing is reached, or an empty text; called in a thread.
        on_event: called with events, as JSON has them.
    """

    def __init__(
        self,
        robot: str,
        link: ZenohLink,
        namespace: Namespace,
        *,
        mode: str | None = None,
        wish: Wish | None = None,
        why_not: Callable[[], str] = str,
        on_event: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        self._mode, self._wish, self._namespace = mode, wish, namespace
        self._missing = ""  # of the wish, in the last answer
        self._followers: dict[str, ServiceFollower] = {}
        self._callers: tuple[str, ...] = ()
        self._stopping = False
        self._next_services_ns = 0
        self._jobs = Jobs()
        self._mirror = Mirror(namespace, self._pass_on, lambda: self.clock.offset_ns(now_ns()))
        self._mirror.watch(self._jobs.fd, self._jobs.run)
        self._peer = Peer(robot, link, self._jobs, self._peer_changed, why_not=why_not, on_event=on_event)
        self._services_key = Keys(robot).services
        link.listen(self._services_key, self._heard_services)
        self._state_writer: BridgeStateWriter | None = None
        self._state = BridgeState(robot, False, self._peer.since_ns, None, None, 0, {})

    @property
    def is_connected(self) -> bool:
        """Whether the robot's bridge is heard."""
        return self._peer.is_connected

    @property
    def clock(self) -> PeerClock:
        """The clock of the robot."""
        return self._peer.clock

    def run(self, each_second: Callable[[BridgeState], object] = lambda _: None) -> None:
        """Run until ``stop``; call ``each_second`` once a second with the state of the bridge."""
        second_ns = now_ns() + NS_PER_S
        with short_turns():
            while not self._stopping:
                self._mirror.answer(_TICK_S)
                with self._mirror.lock:
                    self._look()
                if now_ns() >= second_ns:
                    second_ns = max(second_ns + NS_PER_S, now_ns())
                    with self._mirror.lock:
                        self._mirror.tidy()
                        self._publish_state(self._service_states())
                    each_second(self._state)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True
        self._jobs.wake()

    def close(self) -> None:
        """Withdraw all services."""
        with self._mirror.lock:
            for follower in self._followers.values():
                follower.is_over = True
            self._mirror.close()
            if self._state_writer is not None:
                self._state_writer.close()
                self._state_writer = None
        self._jobs.close()

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

    def _service_states(self) -> dict[str, ServiceState]:
        return {name: follower.report() for name, follower in self._followers.items()}

    def _publish_state(self, services: Mapping[str, ServiceState]) -> None:
        peer, clock = self._peer, self.clock
        self._state = BridgeState(
            peer.keys.robot,
            peer.is_connected,
            peer.since_ns,
            clock.offset_ns(now_ns()) if clock.is_known else None,
            clock.error_ns if clock.is_known else None,
            clock.round_trip_ns,
            services,
            peer.bridges.instance,
            peer.bridges.host,
            peer.bridges.namesakes,
            peer.bridges.switches,
            peer.guard.count + self._jobs.left_out,
            peer.guard.last,
        )
        try:
            if self._state_writer is None:
                self._state_writer = BridgeStateWriter(peer.keys.robot, self._namespace)
            self._state_writer.publish(self._state, now_ns())
        except SkinwareError as error:
            self._state_writer = None
            peer.report_once("state", f"the state of this bridge cannot be published: {error}")

    def _peer_changed(self, change: Change) -> None:
        if change == "appeared":
            self._ask_services()
            return
        for follower in self._followers.values():
            match change:
                case "moved":
                    follower.subscribe()
                case "restarted":
                    follower.start_over()
                case "lost":
                    follower.lose()
                case "clock":
                    follower.take_held()

    # -- services -------------------------------------------------------------------------------------------------

    def _ask_services(self) -> None:
        self._next_services_ns = now_ns() + _SERVICES_NS
        self._peer.ask(
            self._services_key,
            lambda payload, _: self._take_services(payload),
            timeout_s=SLOWEST_ANSWER_S,
            priority=Priority.CALLS,
            payload=b"" if self._wish is None else msgspec.json.encode(self._wish),
        )

    def _heard_services(self, _key: str, payload: bytes) -> None:
        take = partial(self._take_services, payload) if self._wish is None else self._ask_services
        self._peer.soon("a list of services", take, len(payload))

    def _take_services(self, payload: bytes | None) -> None:
        if not payload:
            return
        try:
            robot = read_text(payload, Services)
        except BridgeError as error:
            self._peer.guard.refuse("a list of services", str(error))
            return
        if not self._peer.follows(robot):
            return
        self._callers = robot.callers
        before, self._missing = self._missing, robot.missing
        if robot.missing and robot.missing != before:
            why = f"robot {self._peer.keys.robot}: {robot.missing}"
            self._peer.on_event({"event": "trouble", "about": "part", "why": why})
        ended = {name: Service(state="closed") for name in self._followers if name not in robot.services}
        for name, service in {**robot.services, **ended}.items():
            follower = self._followers.get(name)
            if follower is None:
                if service.state == "closed":
                    continue
                part = "" if self._wish is None else self._wish.number
                follower = ServiceFollower(name, service, self._peer, self._mirror, mode=self._mode, part=part)
                self._followers[name] = follower
            follower.take(service)
            if follower.is_over:
                del self._followers[name]

    # -- requests -------------------------------------------------------------------------------------------------

    def _pass_on(self, name: str, request: Request) -> None:
        self._peer.ask(
            self._peer.keys.of(name, f"call/{request.operation}"),
            lambda payload, _: self._take_answer(name, request, payload),
            timeout_s=_CALL_S,
            priority=Priority.CALLS,
            payload=msgspec.json.encode(request.arguments),
        )

    def _take_answer(self, name: str, request: Request, payload: bytes | None) -> None:
        robot, result = self._peer.keys.robot, None
        if payload is None:
            only = f"; it lets only {', '.join(self._callers)} call" if self._callers else ""
            answer = CallResult(error=f"no answer from robot {robot}{only}")
        else:
            try:
                answer = read_text(payload, CallResult)
                result = read_text(bytes(answer.result), Any)
                self._peer.heard()
            except BridgeError as error:
                self._peer.guard.refuse("an answer to a call", str(error))
                answer = CallResult(error=f"robot {robot} gave an answer that cannot be read: {error}")
        self._mirror.answered(name, request, answer, result)
