"""One service of a robot, followed: its generations, and its frames, pushed or pulled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from skinware.bridge.link import Priority
from skinware.bridge.messages import (
    MOST_FRAMES,
    RAW,
    Service,
    coded_part,
    form_of,
    generation_of,
    slot_of,
    split_generation,
)
from skinware.bridge.mirror import Mirror
from skinware.bridge.pacing import Pacing
from skinware.bridge.peer import ANSWER_S, Peer
from skinware.errors import BadRecording, BridgeError, SkinwareError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S, now_ns
from skinware.transfer.codec import Decoder
from skinware.transfer.collecting import CLOSED, DEAD, LIVE, PAUSED
from skinware.transfer.generation import Generation, RecordedSample, frame_of

Slot = npt.NDArray[np.uint8]
_FIRST_GENERATION_S, _LAST_GENERATION_S = 2.0, 32.0
"""A large structure takes its time on a slow link: each time that none comes, it gets twice as long."""
_AGAIN_NS = NS_PER_S // 4
"""Until a service that could not be published is tried again."""
_LATEST_NS = 1 << 61
"""No clock has counted so far."""
_STATES = {"paused": PAUSED, "live": LIVE, "closed": CLOSED, "dead": DEAD}


@dataclass
class Traffic:
    """What came of a service since it was looked at last.

    Attributes:
        frames: that were published here.
        lost: of the robot's, that were not, since the first one; ``lost_before``: when it was looked at last.
        bytes: of messages.
        ages_ns: from the publication there to the one here.
    """

    frames: int = 0
    lost: int = 0
    lost_before: int = 0
    bytes: int = 0
    ages_ns: list[int] = field(default_factory=list)


class Follower:
    """Publishes a service of a robot. All of it is called with the lock of the mirror held.

    Args:
        name: of the service.
        told: how it is there.
        peer: the robot.
        mirror: publishes it.
        mode: ``push`` or ``pull``; None: it finds out.
        part: number of the wish for some of its sensors; empty: all of it.

    Attributes:
        state: of the service there.
        traffic: what came.
        is_over: nothing that comes is taken any more.
    """

    def __init__(
        self, name: str, told: Service, peer: Peer, mirror: Mirror, *, mode: str | None = None, part: str = ""
    ) -> None:
        self._name, self._peer, self._mirror, self._mode, self._part = name, peer, mirror, mode, part
        self._pacing = Pacing(0, mode)
        self.state: str = told.state
        self.traffic = Traffic()
        self.is_over = False
        self._generation: Generation | None = None  # of which frames can be read
        self._decoder: Decoder | None = None
        self._held = b""  # the newest frame, where its generation or the robot's clock is not known yet
        self._asked = (0, 0)  # number of the generation that was asked for, and until when its answer may come
        self._patience_s = _FIRST_GENERATION_S
        self._count: int | None = None  # the robot's number of the frame published last, over generations
        self._newest = (0, 0)  # position of that frame
        self._last_word = (0, 0)  # of the frame after which it became as it is there
        self._again_ns = 0  # when it may be tried to publish again
        self._is_gone = False  # from here, since the robot was not heard
        self._silence: Callable[[], None] | None = None  # ends the subscription to frames
        self._pulls = 0  # how often the newest frame was asked for
        self._open: dict[int, int] = {}  # until when an answer to a question for it may come, by its number
        self._probe_until_ns = 0  # likewise, to one for a frame as it would be pushed

    @property
    def mode(self) -> str:
        return self._pacing.mode

    @property
    def _of_part(self) -> dict[str, object]:
        return {"part": self._part} if self._part else {}

    @property
    def _of_frame(self) -> str:
        return f"a frame of service {self._name!r}"

    @property
    def _frame_key(self) -> str:
        return self._peer.keys.frame(self._name, self._part)

    def take(self, told: Service) -> None:
        before, self.state = self.state, told.state
        self._last_word = told.generation, told.sequence
        if told.generation and (self._generation is None or self._generation.generation != told.generation):
            self._ask_generation(told.generation)
        if told.state != before or told.state in ("closed", "dead"):
            self._mirror.happened(self._name, _STATES[told.state])
        if told.state == "closed":
            self.is_over = True
            self._unsubscribe()
            self._peer.room.give_back(self._name)

    def look(self, time_ns: int) -> None:
        if not self._peer.is_connected or self._generation is None or not self._peer.clock.is_known:
            return
        self._open = {pull: until_ns for pull, until_ns in self._open.items() if time_ns <= until_ns}
        if self._pacing.pulls:
            self._pull_all()
        elif self._is_gone and not self._open:
            self._pull()
        round_trip_ns = self._peer.clock.round_trip_ns
        if (
            self._pacing.wants_probe(time_ns, round_trip_ns)
            and time_ns > self._probe_until_ns
            and self._count is not None
        ):
            self._probe()

    def start_over(self) -> None:
        self._generation, self._newest, self._count = None, (0, 0), None

    def lost(self) -> None:
        """The robot is not heard any more; whatever was asked is asked again when it is."""
        self._mirror.happened(self._name, DEAD)
        self._is_gone, self._newest = True, (0, 0)
        self._asked, self._patience_s = (0, 0), _FIRST_GENERATION_S
        self._open.clear()
        self._probe_until_ns = 0

    def clock_told(self) -> None:
        if self._held and self._generation is not None:
            self._take_held()

    # -- generations ----------------------------------------------------------------------------------------------

    def _ask_generation(self, number: int) -> None:
        time_ns = now_ns()
        if self._asked[0] == number and time_ns < self._asked[1]:
            return
        self._asked = asked = number, time_ns + round(self._patience_s * NS_PER_S)
        self._peer.ask(
            self._peer.keys.of(self._name, "generation"),
            lambda payload, _: self._take_generation(asked, payload),
            timeout_s=self._patience_s,
            priority=Priority.CALLS,
            parameters={"number": number} | self._of_part,
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
            _check(generation)
            ring = generation.slot_count * generation.slot_stride
            self._peer.room.take(self._name, len(head) + ring)
        except (BridgeError, BadRecording) as error:
            self._refuse(f"service {self._name!r}", error)
            return
        before = self._generation
        if before is not None and generation.generation < before.generation:
            return
        self._generation, self._decoder = generation, None
        if before is None or before.period_ns != generation.period_ns:
            self._pacing = Pacing(generation.period_ns, self._mode, generation.slot_stride)
            self.subscribe()
        self._mirror.operations[self._name] = about.operations
        if self._held:
            self._take_held()
        elif not self._pacing.pulls:
            self._pull()  # the newest one that there is, should no other come for long

    # -- how frames come ------------------------------------------------------------------------------------------

    def subscribe(self) -> None:
        self._unsubscribe()
        self._open.clear()
        if self._generation is not None and not self._pacing.pulls:
            self._silence = self._peer.listen(self._frame_key, self._frame_came)

    def _unsubscribe(self) -> None:
        if self._silence is not None:
            self._silence()
            self._silence = None

    def _frame_came(self, key: str, message: bytes) -> None:
        """In the thread that receives: a frame waits for no other thread."""
        with self._mirror.lock:
            if key == self._frame_key:  # and not of a bridge that is not followed any more
                self._take_frame(message)

    def _pull_all(self, here: RecordedSample | None = None) -> None:
        while len(self._open) < self._pacing.open:
            self._pull(here)

    def _pull(self, here: RecordedSample | None = None) -> None:
        """Ask for a frame that is newer than all that are here; ``here`` is one that is not published yet."""
        self._pulls += 1
        pull, others = self._pulls, len(self._open)
        timeout_s = 2 * (ANSWER_S + self._peer.clock.round_trip_ns / NS_PER_S)
        self._open[pull] = now_ns() + round(timeout_s * NS_PER_S)
        number, sequence = self._newest if here is None else max(self._newest, here.position)
        self._peer.ask(
            self._peer.keys.of(self._name, "newest"),
            lambda payload, _: self._take_pulled(pull, payload),
            timeout_s=timeout_s,
            priority=Priority.PULLED,
            parameters={
                "who": self._peer.who,
                "generation": number,
                "sequence": sequence,
                "base": 0 if self._decoder is None else self._decoder.sequence,
                "others": others,
                **self._of_part,
            },
        )

    def _take_pulled(self, pull: int, message: bytes | None) -> None:
        if self.is_over:
            return
        frame = self._frame_of(message) if message else None
        is_open = self._open.pop(pull, None) is not None  # a late answer begins no second round
        if message is not None:  # answers come in order: those to earlier questions were left out on the link
            self._open = {later: until_ns for later, until_ns in self._open.items() if later > pull}
        if is_open and self._pacing.pulls and message is not None and self._peer.is_connected:
            self._pull_all(frame)  # the next ones are on their way while this one is published
        if frame is not None:
            self._publish(frame)

    def _probe(self) -> None:
        """Ask for a frame as it would be pushed, and look how long it is on its way."""
        asked_ns = now_ns()
        self._probe_until_ns = asked_ns + round(2 * ANSWER_S * NS_PER_S)
        self._peer.ask(
            self._peer.keys.of(self._name, "newest"),
            lambda payload, returned_ns: self._take_probe(returned_ns - asked_ns, payload),
            timeout_s=2 * ANSWER_S,
            priority=Priority.PULLED,
            parameters={"form": RAW} | self._of_part,
        )

    def _take_probe(self, took_ns: int, message: bytes | None) -> None:
        if self.is_over:
            return
        self._probe_until_ns = 0
        if message is not None:
            self._peer.heard()
        if self._pacing.probed(now_ns(), took_ns - self._peer.clock.round_trip_ns):
            self._changed_mode()

    def _changed_mode(self) -> None:
        self._peer.tell({"event": "mode", "service": self._name, "mode": self._pacing.mode})
        self.subscribe()

    # -- frames ---------------------------------------------------------------------------------------------------

    def _take_held(self) -> None:
        held, self._held = self._held, b""
        self._take_frame(held)

    def _take_frame(self, message: bytes) -> None:
        frame = self._frame_of(message)
        if frame is not None:
            self._publish(frame)

    def _frame_of(self, message: bytes) -> RecordedSample | None:
        """The frame of a message; None if it cannot be read, or not yet."""
        if self.is_over:
            return None
        self._peer.heard()
        self.traffic.bytes += len(message)
        try:
            form, number = form_of(message), generation_of(message)
        except BridgeError as error:
            self._refuse(self._of_frame, error)
            return None
        generation = self._generation
        if generation is None or generation.generation != number:
            if generation is None or number > generation.generation:
                self._held = message
                self._ask_generation(number)
            return None
        if not self._peer.clock.is_known:
            self._held = message
            return None
        try:
            return _checked(frame_of(generation, self._slot(form, message, generation)), generation)
        except BadRecording as error:
            self._refuse(self._of_frame, error)
            return None

    def _slot(self, form: int, message: bytes, generation: Generation) -> Slot:
        if form == RAW:
            slot = slot_of(message)
            if len(slot) != generation.slot_stride:
                raise BadRecording(f"a frame of {len(slot)} bytes, not {generation.slot_stride}")
            return slot
        if self._decoder is None:
            self._decoder = Decoder(generation.coded, generation.slot_stride)
        coded, keeps = coded_part(message)
        return self._decoder.decode(coded, keeps=keeps)

    def _publish(self, frame: RecordedSample) -> None:
        generation = self._generation
        if generation is None or frame.position <= self._newest or now_ns() < self._again_ns:
            return
        count = generation.published_before + frame.sequence
        published_ns = frame.published_ns + self._peer.clock.offset_ns(now_ns())
        age_ns = now_ns() - published_ns
        if published_ns < 0 or frame.published_ns - frame.acquired_ns > published_ns:
            self._refuse(self._of_frame, BadRecording("it is from before this machine was started"))
            return
        try:
            self._mirror.publish(self._name, frame, generation)
        except SkinwareError as error:
            self._again_ns = now_ns() + _AGAIN_NS
            self._trouble(error, " cannot appear here")
            return
        if self._count is not None:
            self.traffic.lost += max(0, count - self._count - 1)
        self._count, self._newest, self._is_gone = count, frame.position, False
        if self.state != "live" and frame.position <= self._last_word:  # it came late, and is of before
            self._mirror.happened(self._name, _STATES[self.state])
        self.traffic.frames += 1
        self.traffic.ages_ns.append(age_ns)
        if self._pacing.saw(now_ns(), age_ns, self._peer.clock.round_trip_ns):
            self._changed_mode()

    def _trouble(self, error: SkinwareError, what: str = "") -> None:
        self._peer.say_once(self._name, f"service {self._name!r}{what}: {error}")

    def _refuse(self, kind: str, error: SkinwareError) -> None:
        self._peer.guard.refuse(kind, str(error))


def _check(generation: Generation) -> None:
    """Look whether there can be such a generation.

    Raises:
        BadRecording: there cannot.
    """
    if generation.published_before > MOST_FRAMES or generation.period_ns < 0:
        raise BadRecording(
            f"a generation after {generation.published_before} frames with a period of {generation.period_ns} ns"
        )
    ring = generation.slot_count * generation.slot_stride
    if generation.slot_stride > LIMITS.slot_size or ring > LIMITS.ring_size:
        raise BadRecording(
            f"{generation.slot_count} slots of {generation.slot_stride} bytes; at most {LIMITS.slot_size} each, and"
            f" {LIMITS.ring_size} together"
        )


def _checked(frame: RecordedSample, generation: Generation) -> RecordedSample:
    """The frame, if it can be one.

    Raises:
        BadRecording: its number or its times are of no frame.
    """
    count = generation.published_before + frame.sequence
    if not (0 < frame.sequence <= count <= MOST_FRAMES):
        raise BadRecording(f"it has number {count}")
    if max(frame.acquired_ns, frame.published_ns) > _LATEST_NS:
        raise BadRecording("its times are of no clock")
    return frame
