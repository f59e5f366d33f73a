"""Follow one service of a robot: ask for its generations and frames, and publish them here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from skinware.bridge.link import Priority
from skinware.bridge.messages import MOST_FRAMES, RAW, Service, split_frame, split_generation
from skinware.bridge.mirror import Mirror
from skinware.bridge.pacing import Pacing, Pulls
from skinware.bridge.peer import ANSWER_S, Peer
from skinware.bridge_state import ServiceState
from skinware.errors import BadRecording, BridgeError, SkinwareError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S, now_ns
from skinware.transfer.codec import FrameDecoder
from skinware.transfer.collecting import DEAD
from skinware.transfer.generation import Generation, RecordedSample, frame_of

_FIRST_GENERATION_S, _LAST_GENERATION_S = 2.0, 32.0
"""Patience for a generation; it doubles after each question without an answer, since a slow link needs long."""
_AGAIN_NS = NS_PER_S // 4
"""Pause after a frame that could not be published."""


class FrameOutput:
    """Publishes the frames of a service in order, and counts what came.

    Attributes:
        count: the robot's number of the newest frame, over generations; None: none so far.
        is_dead: nothing was published since the robot was lost.
        frames, bytes, ages_ns: since the last report; ages from the publication there to the one here.
        gap: frames of the robot that were not published here, since the first one.
    """

    def __init__(self, name: str, peer: Peer, mirror: Mirror) -> None:
        self._name, self._peer, self._mirror = name, peer, mirror
        self.count: int | None = None
        self.newest = (0, 0)
        self.is_dead = False
        self.frames = self.bytes = self.gap = self._gap_before = 0
        self.ages_ns: list[int] = []
        self._again_ns = 0

    def report(self, state: str, mode: str) -> ServiceState:
        """Return the state of the service, with the rates since the last report."""
        ages_ns = sorted(self.ages_ns)
        median, oldest = (ages_ns[int(share * len(ages_ns))] if ages_ns else None for share in (0.5, 0.99))
        new = self.gap - self._gap_before
        report = ServiceState(state, mode, self.frames, self.gap, self.bytes, median, oldest, new)
        self.frames, self.bytes, self._gap_before = 0, 0, self.gap
        self.ages_ns.clear()
        return report

    def publish(self, frame: RecordedSample, generation: Generation) -> int | None:
        """Publish a frame, unless it is not newer; raise BadRecording if its times are impossible.

        Returns:
            The time since its publication on the robot, ns; None: it was not published.
        """
        if frame.position <= self.newest or now_ns() < self._again_ns:
            return None
        published_ns = frame.published_ns + self._peer.clock.offset_ns(now_ns())
        age_ns = now_ns() - published_ns
        if published_ns < 0 or frame.published_ns - frame.acquired_ns > published_ns:
            raise BadRecording("it is from before this machine was started")
        try:
            self._mirror.publish(self._name, frame, generation)
        except SkinwareError as error:
            self._again_ns = now_ns() + _AGAIN_NS
            self._peer.report_once(self._name, f"service {self._name!r} cannot appear here: {error}")
            return None
        count = generation.published_before + frame.sequence
        if self.count is not None:
            self.gap += max(0, count - self.count - 1)
        self.count, self.newest, self.is_dead = count, frame.position, False
        self.frames += 1
        self.ages_ns.append(age_ns)
        return age_ns


class ServiceFollower:
    """Follows a service of a robot. Callers hold the lock of the mirror.

    Args:
        mode: ``push`` or ``pull``; None: it follows the link.
        part: number of the wish for some of its sensors; empty: all.

    Attributes:
        service: its newest state there.
    """

    def __init__(
        self, name: str, service: Service, peer: Peer, mirror: Mirror, *, mode: str | None = None, part: str = ""
    ) -> None:
        self._name, self._peer, self._mirror, self._part = name, peer, mirror, part
        self.service = service
        self.output = FrameOutput(name, peer, mirror)
        self.is_over = False
        self._pacing = Pacing(0, mode)
        self._pulls = Pulls()
        self._generation: Generation | None = None
        self._decoder: FrameDecoder | None = None
        self._held = b""  # the newest frame, while its generation or the robot's clock is not known
        self._asked = (0, 0)  # the generation that was asked for, and until when its answer may come
        self._patience_s = _FIRST_GENERATION_S
        self._end_listening: Callable[[], None] = lambda: None

    def report(self) -> ServiceState:
        """Return how the service comes, since the last call."""
        state = self.service.state if self._peer.is_connected else "unheard"
        return self.output.report(state, self._pacing.mode)

    def take(self, service: Service) -> None:
        before, self.service = self.service, service
        if service.generation and (self._generation is None or self._generation.generation != service.generation):
            self._ask_generation(service.generation)
        if service.state != before.state or service.state in ("closed", "dead"):
            self._mirror.happened(self._name, service.state)
        if service.state == "closed":
            self.is_over = True
            self._end_listening()
            self._mirror.budget.release(self._name)

    def look(self, time_ns: int) -> None:
        clock = self._peer.clock
        if not self._peer.is_connected or self._generation is None or not clock.is_known:
            return
        pulls = self._pulls
        pulls.open = {number: until_ns for number, until_ns in pulls.open.items() if time_ns <= until_ns}
        if self._pacing.pulls:
            self._pull_all()
        elif self.output.is_dead and not pulls.open:
            self._pull()
        may_probe = time_ns > pulls.probe_until_ns and self.output.count is not None
        if may_probe and self._pacing.wants_probe(time_ns, clock.round_trip_ns):
            asked_ns = now_ns()
            timeout_s = self._patience_for_frame_s
            pulls.probe_until_ns = asked_ns + round(timeout_s * NS_PER_S)
            self._ask(
                "newest",
                lambda payload, returned_ns: self._probed(returned_ns - asked_ns, payload),
                {"form": RAW},
                timeout_s=timeout_s,
                priority=Priority.PULLED,
            )

    def start_over(self) -> None:
        """Forget the generation: the robot begins new ones."""
        self._generation = None
        self.output.newest, self.output.count = (0, 0), None

    def lose(self) -> None:
        """Show the service as dead, and forget all open questions."""
        self._mirror.happened(self._name, DEAD)
        self.output.is_dead, self.output.newest = True, (0, 0)
        self._asked, self._patience_s = (0, 0), _FIRST_GENERATION_S
        self._pulls.open.clear()
        self._pulls.probe_until_ns = 0

    def take_held(self) -> None:
        if self._held and self._generation is not None:
            held, self._held = self._held, b""
            self._take_frame(held)

    def _ask(
        self, what: str, answered: Callable[[bytes | None, int], None], parameters: dict[str, object], **how: Any
    ) -> None:
        if self._part:
            parameters["part"] = self._part
        self._peer.ask(self._peer.keys.of(self._name, what), answered, parameters=parameters, **how)

    # -- generations ----------------------------------------------------------------------------------------------

    def _ask_generation(self, number: int) -> None:
        time_ns = now_ns()
        if self._asked[0] == number and time_ns < self._asked[1]:
            return
        self._asked = asked = number, time_ns + round(self._patience_s * NS_PER_S)
        self._ask(
            "generation",
            lambda payload, _: self._take_generation(asked, payload),
            {"number": number},
            timeout_s=self._patience_s,
            priority=Priority.CALLS,
            is_large=True,
        )

    def _take_generation(self, asked: tuple[int, int], payload: bytes | None) -> None:
        if self.is_over:
            return
        if self._asked == asked:
            self._asked = 0, 0
            if payload is None:
                self._patience_s = min(2 * self._patience_s, _LAST_GENERATION_S)
        if payload is None:
            return
        self._peer.heard()
        try:
            about, head = split_generation(payload)
            generation = Generation(head, self._name)
            _check_generation(generation)
            self._mirror.budget.reserve(self._name, len(head) + generation.ring_size)
        except (BridgeError, BadRecording) as error:
            self._peer.guard.refuse(f"service {self._name!r}", str(error))
            return
        before = self._generation
        if before is not None and generation.generation < before.generation:
            return
        self._generation, self._decoder = generation, None
        if before is None or before.period_ns != generation.period_ns:
            self._pacing = Pacing(generation.period_ns, self._pacing.fixed, generation.slot_stride)
            self.subscribe()
        self._mirror.operations[self._name] = about.operations
        if self._held:
            self.take_held()
        elif not self._pacing.pulls:
            self._pull()  # the newest frame, in case no other comes for long

    # -- questions for frames -------------------------------------------------------------------------------------

    def subscribe(self) -> None:
        """Listen to frames if they are pushed; frames that were asked for before do not count."""
        self._end_listening()
        self._pulls.open.clear()
        if self._generation is not None and not self._pacing.pulls:
            self._end_listening = self._peer.listen(self._peer.keys.frame(self._name, self._part), self._pushed)

    def _pushed(self, key: str, message: bytes) -> None:
        """Take a frame in the receiving thread: handing over would cost time."""
        with self._mirror.lock:
            if key == self._peer.keys.frame(self._name, self._part):  # not from a bridge that was followed before
                self._take_frame(message)

    @property
    def _patience_for_frame_s(self) -> float:
        return 2 * (ANSWER_S + self._peer.clock.round_trip_ns / NS_PER_S)

    def _pull_all(self, here: RecordedSample | None = None) -> None:
        while len(self._pulls.open) < self._pacing.open:
            self._pull(here)

    def _pull(self, here: RecordedSample | None = None) -> None:
        """Ask for a frame that is newer than all that came; ``here`` is one that is not published yet."""
        others = len(self._pulls.open)
        timeout_s = self._patience_for_frame_s
        pull = self._pulls.begin(timeout_s)
        number, sequence = self.output.newest if here is None else max(self.output.newest, here.position)
        known = {"generation": number, "sequence": sequence, "base": self._decoder.sequence if self._decoder else 0}
        self._ask(
            "newest",
            lambda payload, _: self._pulled(pull, payload),
            {"who": self._peer.who, **known, "others": others},
            timeout_s=timeout_s,
            priority=Priority.PULLED,
        )

    def _pulled(self, pull: int, message: bytes | None) -> None:
        if self.is_over:
            return
        frame = self._read(message) if message else None
        is_open = self._pulls.end(pull, message is not None)  # a late answer begins no second round
        if is_open and self._pacing.pulls and message is not None and self._peer.is_connected:
            self._pull_all(frame)  # the next ones are on their way while this one is published
        if frame is not None:
            self._publish(frame)

    def _probed(self, took_ns: int, message: bytes | None) -> None:
        if self.is_over:
            return
        self._pulls.probe_until_ns = 0
        if message is not None:
            self._peer.heard()
        if self._pacing.probed(now_ns(), took_ns - self._peer.clock.round_trip_ns):
            self._change_mode()

    def _change_mode(self) -> None:
        self._peer.on_event({"event": "mode", "service": self._name, "mode": self._pacing.mode})
        self.subscribe()

    # -- frames ---------------------------------------------------------------------------------------------------

    def _take_frame(self, message: bytes) -> None:
        frame = self._read(message)
        if frame is not None:
            self._publish(frame)

    def _refuse_frame(self, error: SkinwareError) -> None:
        self._peer.guard.refuse(f"a frame of service {self._name!r}", str(error))

    def _read(self, message: bytes) -> RecordedSample | None:
        """Return the frame of a message; None if it cannot be read, or not yet."""
        if self.is_over:
            return None
        self._peer.heard()
        self.output.bytes += len(message)
        try:
            parts = split_frame(message)
            generation = self._generation
            if generation is None or generation.generation != parts.generation:
                if generation is None or parts.generation > generation.generation:
                    self._held = message
                    self._ask_generation(parts.generation)
                return None
            if not self._peer.clock.is_known:
                self._held = message
                return None
            if parts.form == RAW:
                if len(parts.content) != generation.slot_stride:
                    raise BadRecording(f"a frame of {len(parts.content)} bytes, not {generation.slot_stride}")
                slot = np.frombuffer(parts.content, np.uint8)
            else:
                self._decoder = self._decoder or FrameDecoder(generation.coded, generation.slot_stride)
                slot = self._decoder.decode(parts.content, keeps=parts.keeps)
            frame = frame_of(generation, slot)
            count = generation.published_before + frame.sequence
            if not (0 < frame.sequence <= count <= MOST_FRAMES):
                raise BadRecording(f"it has number {count}")
            if max(frame.acquired_ns, frame.published_ns) > LIMITS.time_ns:
                raise BadRecording("its times are of no clock")
        except (BridgeError, BadRecording) as error:
            self._refuse_frame(error)
            return None
        return frame

    def _publish(self, frame: RecordedSample) -> None:
        if self._generation is None:
            return
        try:
            age_ns = self.output.publish(frame, self._generation)
        except BadRecording as error:
            self._refuse_frame(error)
            return
        if age_ns is None:
            return
        service = self.service
        if service.state != "live" and frame.position <= (service.generation, service.sequence):
            self._mirror.happened(self._name, service.state)  # the frame is older than the state
        if self._pacing.arrived(now_ns(), age_ns, self._peer.clock.round_trip_ns):
            self._change_mode()


def _check_generation(generation: Generation) -> None:
    if generation.published_before > MOST_FRAMES or generation.period_ns < 0:
        raise BadRecording(
            f"a generation after {generation.published_before} frames with a period of {generation.period_ns} ns"
        )
    if generation.slot_stride > LIMITS.slot_size or generation.ring_size > LIMITS.ring_size:
        raise BadRecording(
            f"{generation.slot_count} slots of {generation.slot_stride} bytes; at most {LIMITS.slot_size} each, and"
            f" {LIMITS.ring_size} together"
        )
