"""The other end of a bridge: a robot's services appear here, as they are there."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.bridge.clock import PeerClock, Sample
from skinware.bridge.link import Link, Priority, Reply
from skinware.bridge.messages import (
    ALL_TOKENS,
    CLOCK,
    RAW,
    VERSION,
    Answered,
    Keys,
    Service,
    Services,
    coded_part,
    form_of,
    generation_of,
    parts_of,
    slot_of,
    split_generation,
    token_parts,
)
from skinware.bridge.mirror import Mirror
from skinware.bridge.pacing import Pacing
from skinware.errors import BadRecording, BridgeError, NameInUse, SkinwareError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns, short_turns
from skinware.recording.codec import Decoder
from skinware.recording.frames import frame_of
from skinware.recording.generation import Generation
from skinware.recording.timeline import CLOSED, DEAD, LIVE, PAUSED
from skinware.service import Request

Slot = npt.NDArray[np.uint8]
_TICK_S = 0.02
_SERVICES_NS = NS_PER_S
"""Between two questions for all services: what is told unasked may not arrive."""
_ANSWER_S = 1.0
_FIRST_GENERATION_S, _LAST_GENERATION_S = 2.0, 32.0
"""A large structure takes its time on a slow link: each time that none comes, it gets twice as long."""
_CALL_S = 30.0
_PATIENCE_NS = 3 * NS_PER_S
"""With nobody there, until it is looked at why, and until it is looked at again."""
_PING_NS = 150_000_000
_SILENCE_NS = 400_000_000


@dataclass
class Traffic:
    """What came of a service since it was looked at last.

    Attributes:
        frames: that were published here.
        lost: of the robot's, that were not, since the first one.
        bytes: of messages.
        ages_ns: from the publication there to the one here.
    """

    frames: int = 0
    lost: int = 0
    bytes: int = 0
    ages_ns: list[int] = field(default_factory=list)


@dataclass
class _Mirrored:
    """A service of the robot.

    Attributes:
        told: how it is there.
        pacing: how its frames come.
        generation: of which frames can be read, None before the first is known.
        held: the newest frame, where its generation or the robot's clock is not known yet.
        asked: number of the generation that was asked for, and until when its answer may come.
        patience_s: how long such an answer may take.
        count: the robot's number of the frame that was published last, over generations.
        newest: position of that frame.
        silence: ends the subscription to its frames.
        pull_until_ns: until when an answer to the question for the newest frame may come, 0 if none is open.
        probe_until_ns: likewise, to one for a frame as it would be pushed.
    """

    told: Service
    pacing: Pacing
    generation: Generation | None = None
    decoder: Decoder | None = None
    held: bytes = b""
    asked: tuple[int, int] = (0, 0)
    patience_s: float = _FIRST_GENERATION_S
    count: int | None = None
    newest: tuple[int, int] = (0, 0)
    silence: Callable[[], None] | None = None
    pull_until_ns: int = 0
    probe_until_ns: int = 0
    traffic: Traffic = field(default_factory=Traffic)


class Joiner:
    """Publishes the services of a robot in a namespace of this machine, until it is stopped.

    Args:
        robot: its name.
        link: to it.
        namespace: where its services appear.
        mode: ``push`` or ``pull``; None: it finds out for each service.
        why_not: why nobody is reached, a line for people, empty if somebody is; called in a thread, may wait.
        tell: is told what happens, as JSON has it.

    Attributes:
        clock: of the robot.
    """

    def __init__(
        self,
        robot: str,
        link: Link,
        namespace: Namespace,
        *,
        mode: str | None = None,
        why_not: Callable[[], str] = str,
        tell: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        self._keys, self._link, self._mode, self._tell = Keys(robot), link, mode, tell
        self._mirror = Mirror(namespace, self._pass_on, lambda: self.clock.offset_ns(now_ns()))
        self._lock = self._mirror.lock
        self._is_closed = False
        self._services: dict[str, _Mirrored] = {}
        self._jobs: deque[Callable[[], None]] = deque()
        self._who = os.urandom(8).hex()
        self._instance = self._start = ""
        self._there: set[str] = set()  # bridges that serve the robot
        self._others: set[str] = set()  # other robots
        self._why_not, self._next_why_ns, self._asking_why = why_not, now_ns() + _PATIENCE_NS, False
        self._callers: tuple[str, ...] = ()
        self._stopping = False
        self._connected = False
        self._heard_ns = self._pinged_ns = self._next_clock_ns = self._next_services_ns = 0
        self._told: set[str] = set()
        self.clock = PeerClock()
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._mirror.watch(self._wake, self._work)
        link.watch(ALL_TOKENS, lambda key, there: self._soon(lambda: self._token(key, there)))
        link.listen(self._keys.services, lambda _key, payload: self._soon(lambda: self._take_services(payload)))

    @property
    def is_connected(self) -> bool:
        """Whether the robot's bridge is heard."""
        return self._connected

    def run(self, tell: Callable[[], object] = lambda: None) -> None:
        """Until ``stop``; ``tell`` is called once a second."""
        tell_ns = now_ns() + NS_PER_S
        with short_turns():
            while not self._stopping:
                self._mirror.answer(_TICK_S)
                with self._lock:
                    self._look()
                if now_ns() >= tell_ns:
                    tell_ns = max(tell_ns + NS_PER_S, now_ns())
                    with self._lock:
                        self._mirror.tidy()
                    tell()

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True
        self._ring()

    def close(self) -> None:
        """Withdraw all that is published."""
        with self._lock:
            self._is_closed = True
            self._mirror.close()
        os.close(self._wake)

    def traffic(self) -> Mapping[str, tuple[str, str, Traffic]]:
        """(state, mode, what came since the last call) of every service."""
        taken = {}
        with self._lock:
            for name, mirrored in self._services.items():
                state = mirrored.told.state if self._connected else "unheard"
                taken[name] = (state, mirrored.pacing.mode, mirrored.traffic)
                mirrored.traffic = Traffic(lost=mirrored.traffic.lost)
        return taken

    # -- jobs: what comes in zenoh's threads, but for frames, is done in the one that runs ------------------------

    def _soon(self, job: Callable[[], None]) -> None:
        self._jobs.append(job)
        self._ring()

    def _ring(self) -> None:
        with contextlib.suppress(OSError):  # closed
            os.eventfd_write(self._wake, 1)

    def _work(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        for _ in range(len(self._jobs)):
            self._jobs.popleft()()

    # -- who is there ---------------------------------------------------------------------------------------------

    def _token(self, key: str, there: bool) -> None:
        robot, version, instance = token_parts(key)
        if robot != self._keys.robot:
            (self._others.add if there else self._others.discard)(robot)
            return
        (self._there.add if there else self._there.discard)(instance)
        if there and version != VERSION:
            self._say_once(
                "version",
                f"robot {self._keys.robot} is served by version {version or '?'} of the bridge; this one is {VERSION}:"
                " install the same on both machines",
            )
        elif there:
            self._ask_services()
            self._ask_clock()
        elif instance == self._instance:
            self._lose("its bridge ended")

    def _ask_services(self) -> None:
        self._next_services_ns = now_ns() + _SERVICES_NS
        self._link.ask(
            self._keys.services,
            lambda reply: self._soon(lambda: self._take_services(reply.payload)),
            timeout_s=_ANSWER_S,
            priority=Priority.CALLS,
        )

    def _take_services(self, payload: bytes | None) -> None:
        if not payload:
            return
        try:
            told = msgspec.json.decode(payload, type=Services)
        except msgspec.MsgspecError as error:
            self._say_once("services", f"robot {self._keys.robot} tells what cannot be read: {error}")
            return
        self._heard()
        if self._instance and told.instance != self._instance and self._instance in self._there:
            self._say_once(
                "robot", f"robot {self._keys.robot} is served by two bridges: give each robot a name of its own"
            )
            return
        self._instance = told.instance
        if told.start != self._start:
            self._start = told.start
            self.clock = PeerClock()
            self._ask_clock()
            for mirrored in self._services.values():
                mirrored.generation, mirrored.newest, mirrored.count = None, (0, 0), None
        self._callers = told.callers
        for name, service in told.services.items():
            self._take_service(name, service)
        for name in [name for name in self._services if name not in told.services]:
            self._take_service(name, Service(state="closed"))

    def _take_service(self, name: str, told: Service) -> None:
        mirrored = self._services.get(name)
        if mirrored is None:
            if told.state == "closed":
                return
            mirrored = self._services[name] = _Mirrored(told, Pacing(0, self._mode))
        before, mirrored.told = mirrored.told, told
        if told.generation and (mirrored.generation is None or mirrored.generation.generation != told.generation):
            self._ask_generation(name, mirrored, told.generation)
        if told.state != before.state or told.state in ("closed", "dead"):
            self._mirror.happened(name, {"paused": PAUSED, "live": LIVE, "closed": CLOSED, "dead": DEAD}[told.state])
        if told.state == "closed":
            self._forget(name)

    def _forget(self, name: str) -> None:
        mirrored = self._services.pop(name)
        if mirrored.silence is not None:
            mirrored.silence()

    def _heard(self) -> None:
        self._heard_ns = now_ns()
        if not self._connected:
            self._connected = True
            self._told.clear()
            self._tell({"event": "connected", "robot": self._keys.robot})

    def _lose(self, why: str) -> None:
        if not self._connected:
            return
        self._connected = False
        for name, mirrored in self._services.items():
            self._mirror.happened(name, DEAD)
            mirrored.pull_until_ns = 0
        self._tell({"event": "disconnected", "robot": self._keys.robot, "why": why})

    def _look(self) -> None:
        """What is to be done by the clock."""
        time_ns = now_ns()
        if time_ns >= self._next_clock_ns:
            self._ask_clock()
        if time_ns >= self._next_services_ns:
            self._ask_services()
        if self._connected and time_ns - self._heard_ns > _SILENCE_NS - _PING_NS:
            if time_ns - self._heard_ns > _SILENCE_NS:
                self._lose("nothing comes over the link")
            elif time_ns - self._pinged_ns > _PING_NS:
                self._ask_clock()
        if not self._connected and time_ns >= self._next_why_ns and not self._asking_why:
            self._asking_why, self._next_why_ns = True, time_ns + _PATIENCE_NS
            threading.Thread(target=self._ask_why, name="skinware bridge diagnosis", daemon=True).start()
        for name, mirrored in self._services.items():
            if not self._connected or mirrored.generation is None or not self.clock.is_known:
                continue
            if mirrored.pacing.pulls and time_ns > mirrored.pull_until_ns:
                self._pull(name, mirrored)
            if (
                mirrored.pacing.wants_probe(time_ns)
                and time_ns > mirrored.probe_until_ns
                and mirrored.count is not None
            ):
                self._probe(name, mirrored)

    def _ask_why(self) -> None:
        why = self._why_not()

        def tell() -> None:
            self._asking_why = False
            if self._connected:
                return
            others = f"; there are: {', '.join(sorted(self._others))}" if self._others else ""
            silent = f"something listens there, but no robot {self._keys.robot!r} answers; does it want --tls?{others}"
            self._say_once("link", why or silent)

        self._soon(tell)

    # -- clock ----------------------------------------------------------------------------------------------------

    def _ask_clock(self) -> None:
        asked_ns = self._pinged_ns = now_ns()
        self._next_clock_ns = asked_ns + self.clock.pause_ns()

        def returned(reply: Reply) -> None:
            returned_ns = now_ns()
            self._soon(lambda: self._take_clock(asked_ns, reply.payload, returned_ns))

        self._link.ask(self._keys.clock, returned, timeout_s=_ANSWER_S, priority=Priority.CLOCK)

    def _take_clock(self, asked_ns: int, payload: bytes | None, returned_ns: int) -> None:
        if payload is None or len(payload) != CLOCK.size:
            return
        self._heard()
        heard_ns, answered_ns = CLOCK.unpack(payload)
        self.clock.add(Sample.of(asked_ns, heard_ns, answered_ns, returned_ns))
        for name, mirrored in self._services.items():
            if mirrored.held and mirrored.generation is not None:
                held, mirrored.held = mirrored.held, b""
                self._take_frame(name, held)

    # -- generations ----------------------------------------------------------------------------------------------

    def _ask_generation(self, name: str, mirrored: _Mirrored, number: int) -> None:
        time_ns = now_ns()
        if mirrored.asked[0] == number and time_ns < mirrored.asked[1]:
            return
        mirrored.asked = number, time_ns + round(mirrored.patience_s * NS_PER_S)
        self._link.ask(
            self._keys.of(name, "generation"),
            lambda reply: self._soon(lambda: self._take_generation(name, number, reply.payload)),
            timeout_s=mirrored.patience_s,
            priority=Priority.CALLS,
            parameters={"number": number},
        )

    def _take_generation(self, name: str, number: int, payload: bytes | None) -> None:
        mirrored = self._services.get(name)
        if mirrored is None:
            return
        if mirrored.asked[0] == number:
            mirrored.asked = 0, 0
        if payload is None:
            mirrored.patience_s = min(2 * mirrored.patience_s, _LAST_GENERATION_S)
            return
        self._heard()
        try:
            about, head = split_generation(payload)
            generation = Generation(head, name)
        except (BridgeError, BadRecording) as error:
            self._say_once(name, f"service {name!r} cannot be read: {error}")
            return
        if mirrored.generation is not None and generation.generation < mirrored.generation.generation:
            return
        before, mirrored.generation, mirrored.decoder = mirrored.generation, generation, None
        if before is None or before.period_ns != generation.period_ns:
            mirrored.pacing = Pacing(generation.period_ns, self._mode)
            self._listen_to(name, mirrored)
        self._mirror.operations[name] = about.operations
        held, mirrored.held = mirrored.held, b""
        if held:
            self._take_frame(name, held)
        elif not mirrored.pacing.pulls:
            self._pull(name, mirrored)  # the newest one that there is, should no other come for long

    # -- frames ---------------------------------------------------------------------------------------------------

    def _listen_to(self, name: str, mirrored: _Mirrored) -> None:
        """Have its frames come, as its pacing wants it."""
        if mirrored.silence is not None:
            mirrored.silence()
            mirrored.silence = None
        if mirrored.pacing.pulls:
            mirrored.pull_until_ns = 0
        else:
            mirrored.silence = self._link.listen(self._keys.of(name, "frame"), self._frame_came)

    def _frame_came(self, key: str, message: bytes) -> None:
        """In the thread that receives: a frame waits for no other thread."""
        with self._lock:
            if not self._is_closed:
                self._take_frame(parts_of(key)[0], message)

    def _pull(self, name: str, mirrored: _Mirrored) -> None:
        mirrored.pull_until_ns = now_ns() + round(2 * _ANSWER_S * NS_PER_S)
        number, sequence = mirrored.newest
        decoder = mirrored.decoder

        def came(reply: Reply) -> None:
            self._soon(lambda: self._take_pulled(name, reply.payload))

        self._link.ask(
            self._keys.of(name, "newest"),
            came,
            timeout_s=2 * _ANSWER_S,
            priority=Priority.PULLED,
            parameters={
                "who": self._who,
                "generation": number,
                "sequence": sequence,
                "base": 0 if decoder is None else decoder.sequence,
            },
        )

    def _probe(self, name: str, mirrored: _Mirrored) -> None:
        """Ask for a frame as it would be pushed, and look how long it is on its way."""
        asked_ns = now_ns()
        mirrored.probe_until_ns = asked_ns + round(2 * _ANSWER_S * NS_PER_S)

        def came(reply: Reply) -> None:
            took_ns = now_ns() - asked_ns
            self._soon(lambda: self._take_probe(name, took_ns, reply.payload))

        self._link.ask(
            self._keys.of(name, "newest"),
            came,
            timeout_s=2 * _ANSWER_S,
            priority=Priority.PULLED,
            parameters={"form": RAW},
        )

    def _take_probe(self, name: str, took_ns: int, message: bytes | None) -> None:
        mirrored = self._services.get(name)
        if mirrored is None:
            return
        mirrored.probe_until_ns = 0
        if message is not None:
            self._heard()
        if mirrored.pacing.probed(now_ns(), took_ns - self.clock.round_trip_ns):
            self._changed_mode(name, mirrored)

    def _changed_mode(self, name: str, mirrored: _Mirrored) -> None:
        self._tell({"event": "mode", "service": name, "mode": mirrored.pacing.mode})
        self._listen_to(name, mirrored)

    def _take_pulled(self, name: str, message: bytes | None) -> None:
        mirrored = self._services.get(name)
        if mirrored is None:
            return
        mirrored.pull_until_ns = 0
        if mirrored.pacing.pulls and message is not None and self._connected:
            self._pull(name, mirrored)  # the next one is on its way while this one is published
        if message:
            self._take_frame(name, message)

    def _take_frame(self, name: str, message: bytes) -> None:
        mirrored = self._services.get(name)
        if mirrored is None:
            return
        self._heard()
        mirrored.traffic.bytes += len(message)
        try:
            form, number = form_of(message), generation_of(message)
        except BridgeError as error:
            self._say_once(name, f"service {name!r}: {error}")
            return
        generation = mirrored.generation
        if generation is None or generation.generation != number:
            if generation is None or number > generation.generation:
                mirrored.held = message
                self._ask_generation(name, mirrored, number)
            return
        if not self.clock.is_known:
            mirrored.held = message
            return
        try:
            if form == RAW:
                slot = slot_of(message)
                if len(slot) != generation.slot_stride:
                    raise BadRecording(f"a frame of {len(slot)} bytes, not {generation.slot_stride}")
            else:
                if mirrored.decoder is None:
                    mirrored.decoder = Decoder(generation.coded, generation.slot_stride)
                slot = mirrored.decoder.decode(coded_part(message))
        except BadRecording as error:
            mirrored.decoder = None
            self._say_once(name, f"service {name!r}: {error}")
            return
        self._publish(name, mirrored, generation, slot)

    def _publish(self, name: str, mirrored: _Mirrored, generation: Generation, slot: Slot) -> None:
        frame = frame_of(generation, slot)
        count = generation.published_before + frame.sequence
        if frame.position <= mirrored.newest:
            return
        age_ns = now_ns() - self.clock.offset_ns(now_ns()) - frame.published_ns
        try:
            self._mirror.publish(name, frame, generation)
        except NameInUse as error:
            self._say_once(name, f"service {name!r} cannot appear here: {error}")
            return
        except SkinwareError as error:
            self._say_once(name, f"service {name!r}: {error}")
            return
        if mirrored.count is not None:
            mirrored.traffic.lost += max(0, count - mirrored.count - 1)
        mirrored.count, mirrored.newest = count, frame.position
        mirrored.traffic.frames += 1
        mirrored.traffic.ages_ns.append(age_ns)
        if mirrored.pacing.saw(now_ns(), age_ns):
            self._changed_mode(name, mirrored)

    # -- requests -------------------------------------------------------------------------------------------------

    def _pass_on(self, name: str, request: Request) -> None:
        def returned(reply: Reply) -> None:
            self._soon(lambda: self._take_answer(name, request, reply))

        self._link.ask(
            self._keys.call(name, request.operation),
            returned,
            timeout_s=_CALL_S,
            priority=Priority.CALLS,
            payload=msgspec.json.encode(request.arguments),
        )

    def _take_answer(self, name: str, request: Request, reply: Reply) -> None:
        robot = self._keys.robot
        if reply.payload is None:
            only = f"; it lets only {', '.join(self._callers)} call" if self._callers else ""
            self._mirror.answered(name, request, Answered(error=f"no answer from robot {robot}{only}"), None)
            return
        try:
            answer = msgspec.json.decode(reply.payload, type=Answered)
            result = msgspec.json.decode(answer.result)
        except msgspec.MsgspecError as error:
            self._mirror.answered(name, request, Answered(error=f"robot {robot} answers nonsense: {error}"), None)
            return
        self._heard()
        self._mirror.answered(name, request, answer, result)

    def _say_once(self, about: str, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self._tell({"event": "trouble", "about": about, "why": text})


__all__ = ["Joiner", "Traffic"]
