"""What comes over the wire, for hypothesis: bursts as devices send them, and everything that can go wrong with them.

A script knows nothing of the skin that it is played on: its numbers are taken modulo what there is. So both shrink
on their own.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from hypothesis import strategies as st

from skinware_drivers.bus import EXTENDED_FLAG, REMOTE_FLAG
from skinware_drivers.description import Patch
from skinware_drivers.fields import Bits, Byte, Identifier, SequenceNumber
from skinware_drivers.layout import Frame, Layout
from tests.native.skins import SkinDesign
from tests.specification.both_paths import Pair
from tests.specification.one_path import Way

Wire = tuple[int, int, int, bytes]
"""Bus, time_ns, identifier, payload."""
_ARRIVAL_NS = 50_000
_PATTERNS = (b"\0", b"\xff", b"\x01\x00\xa0\x7f", b"\x7f\xa0\x00\x01", b"\x00\x00\xc0\xff", b"\x80")


@dataclass(frozen=True)
class Burst:
    """All frames of all modules of a patch.

    Attributes:
        patch: which.
        value: what the payloads are made of; 0 and 1: all bits 0 and 1.
        faults: (place among the frames, what is wrong with it) each.
        pace: time from frame to frame, thousandths of a period.
        counts: by how much counters go on.
        cut: frames after which the batch ends; None: none.
    """

    patch: int = 0
    value: int = 0
    faults: Sequence[tuple[int, str]] = ()
    pace: int = 1
    counts: int = 1
    cut: int | None = None


@dataclass(frozen=True)
class Stray:
    """A frame of somebody else, or of nobody."""

    bus: int
    identifier: int
    length: int
    value: int


@dataclass(frozen=True)
class Digest:
    """The batch ends; ``interrupted``: buses that are known to have lost frames, one bit each."""

    interrupted: int = 0


@dataclass(frozen=True)
class Pass:
    """Time passes, hundredths of a period; ``is_watched``: what is due meanwhile is published when it is.

    ``unread``: at its end, what has arrived since is not taken yet, hundredths of a period.
    """

    centiperiods: int = 100
    is_watched: bool = True
    unread: int = 0


@dataclass(frozen=True)
class Happen:
    """Something that is no frame: ``ask``, or ``restart``, ``suspect`` or ``calm`` a patch."""

    what: str
    patch: int = 0


@dataclass(frozen=True)
class Sender:
    """A patch that sends bursts by a clock of its own; times are thousandths of the nominal period.

    Attributes:
        phase: when the first begins.
        period: from one to the next.
        length: from the first frame of one to its last.
        lost: frames that never come, counted from the first of all.
        stalls: (frame, how long it and all after it are held up) each; then it catches up.
    """

    phase: int = 0
    period: int = 1000
    length: int = 300
    lost: Sequence[int] = ()
    stalls: Sequence[tuple[int, int]] = ()


Event = Burst | Stray | Digest | Pass | Happen

FAULTS = (
    "lost",
    "short",
    "long",
    "garbage",
    "other header",
    "other module",
    "stranger's length",
    "twice",
    "swapped",
    "late",
    "early",
    "before boot",
)

_bursts = st.builds(
    Burst,
    patch=st.integers(0, 5),
    value=st.integers(0, 40),
    faults=st.lists(st.tuples(st.integers(0, 30), st.sampled_from(FAULTS)), max_size=3),
    pace=st.sampled_from([1, 0, 10, 60, 300]),
    counts=st.sampled_from([1, 1, 1, 0, 2, -1, 100]),
    cut=st.none() | st.integers(0, 20),
)
_strays = st.builds(
    Stray,
    bus=st.integers(0, 2),
    identifier=st.sampled_from(
        [0, 0x100, 0x101, 0x110, 0x1FF, 0x7FF, 0x800, EXTENDED_FLAG | 0x18DA_0005, EXTENDED_FLAG, REMOTE_FLAG | 0x100]
    ),
    length=st.integers(0, 9),
    value=st.integers(0, 8),
)
_events = st.one_of(
    _bursts,
    _bursts,
    _bursts,
    st.builds(Digest, st.sampled_from([0, 0, 0, 1, 2, 7])),
    st.builds(
        Pass,
        st.sampled_from([100, 100, 50, 90, 110, 10, 200, 300, 1000, 5000]),
        st.booleans(),
        st.sampled_from([0, 0, 5, 40, 120]),
    ),
    st.builds(Pass),
    _strays,
    st.builds(Happen, st.sampled_from(["ask", "ask", "restart", "suspect", "calm"]), st.integers(0, 5)),
)
scripts = st.lists(_events, min_size=1, max_size=30)
_places = st.integers(0, 150)
senders = st.lists(
    st.builds(
        Sender,
        phase=st.integers(0, 1000),
        period=st.sampled_from([1000, 970, 1030, 500, 2000, 250, 90]),
        length=st.sampled_from([300, 0, 10, 600, 850, 1500]),
        lost=st.lists(_places, max_size=6),
        stalls=st.lists(st.tuples(_places, st.sampled_from([100, 400, 900, 1000, 1100, 3000])), max_size=2),
    ),
    min_size=1,
    max_size=4,
)
BURSTS, _PACE_NS = 10, 20_000
"""That each sender sends; and the time between two frames of one that catches up."""


@dataclass
class Player:
    """Plays a script on both paths.

    Attributes:
        design: the skin.
        pair: the paths.
    """

    design: SkinDesign
    pair: Pair
    _waiting: list[Wire] = field(default_factory=list)
    _counts: dict[tuple[int, int, int], int] = field(default_factory=dict)
    _stamp_ns: int = 0

    def __post_init__(self) -> None:
        self._patches: list[tuple[int, Layout, Patch]] = [
            (number, bus.layout, patch)
            for number, bus in enumerate(self.design.buses)
            for patch in bus.patches
            if bus.layout is not None
        ]
        self._stamp_ns = self.pair.clock.now_ns

    @property
    def _period_ns(self) -> int:
        return self.pair.numpy.publisher.pace.period_ns

    def play(self, script: Sequence[Event]) -> None:
        """Do all of it, and wait for what is left."""
        for event in script:
            match event:
                case Burst():
                    self._send(event)
                case Stray():
                    self._stray(event)
                case Digest():
                    self._digest([bus for bus in range(len(self.design.buses)) if event.interrupted >> bus & 1])
                case Pass():
                    self._pass(event)
                case Happen():
                    self._happen(event)
        self._digest()
        self._pass(Pass(400))

    def play_senders(self, senders: Sequence[Sender], cuts: Sequence[int], is_watched: bool) -> None:
        """What patches send, each by its own clock, in batches.

        Args:
            senders: in the order of the patches; more or less of them than there are patches.
            cuts: frames of a batch, over and over.
            is_watched: what is due between two batches is published then.
        """
        stream = [
            wire
            for (bus, layout, patch), sender in zip(self._patches, itertools.cycle(senders), strict=False)
            for wire in self._sent_by(sender, bus, layout, patch)
        ]
        stream.sort(key=lambda wire: wire[1])
        sizes = itertools.cycle(cuts)
        while stream:
            size = next(sizes)
            self._waiting, stream = stream[:size], stream[size:]
            if is_watched:
                self.pair.pass_to(self._waiting[0][1])
            self._digest()
        self._pass(Pass(400))

    def _sent_by(self, sender: Sender, bus: int, layout: Layout, patch: Patch) -> Iterator[Wire]:
        sent = [(module.key, frame) for module in patch.modules for frame in layout.frames]
        held_ns = before_ns = 0
        for burst in range(BURSTS):
            for place, (key, frame) in enumerate(sent):
                number = burst * len(sent) + place
                due = sender.phase + burst * sender.period + sender.length * place // len(sent)
                due_ns = self._stamp_ns + due * self._period_ns // 1000
                for _, length in (stall for stall in sender.stalls if stall[0] == number):
                    held_ns = due_ns + length * self._period_ns // 1000
                before_ns = max(due_ns, held_ns, before_ns + _PACE_NS)
                payload = self._payload(layout, frame, patch.key, key, Burst(value=burst + 2), place, ())
                if number not in sender.lost and payload is not None:
                    yield bus, before_ns, identifier_of(frame, patch.key, key), payload

    def _digest(self, interrupted: Sequence[int] = ()) -> None:
        clock = self.pair.clock
        stamps_ns = [time_ns for _, time_ns, _, _ in self._waiting]
        clock.now_ns = max(clock.now_ns, max(stamps_ns, default=0)) + _ARRIVAL_NS
        frames, self._waiting = self._waiting, []
        self.pair.feed(frames, interrupted)
        self._stamp_ns = max(self._stamp_ns, clock.now_ns - _ARRIVAL_NS)

    def _pass(self, event: Pass) -> None:
        if self._waiting:
            self._digest()
        clock, pair = self.pair.clock, self.pair
        end_ns = clock.now_ns + event.centiperiods * self._period_ns // 100
        if event.is_watched:
            pair.pass_to(end_ns)
        self._stamp_ns = clock.now_ns = max(clock.now_ns, end_ns)
        pair.publish_if_due(event.unread * self._period_ns // 100)

    def _happen(self, event: Happen) -> None:
        number = event.patch % len(self._patches)
        now_ns = self.pair.clock.now_ns

        def act(way: Way) -> None:
            if event.what == "ask" and way.desk is not None:
                way.desk.waiting.append(now_ns)
            elif event.what == "restart":
                way.decoder.forget(number)
                way.watch.forget(number)
            elif event.what == "suspect":
                way.watch.suspect(number)
            elif event.what == "calm":
                way.watch.forget(number)

        self.pair.do(act)

    def _stray(self, event: Stray) -> None:
        longest = self.pair.numpy.batch.payload_size
        payload = _bytes(event.value, min(event.length, longest))
        self._waiting.append((event.bus % len(self.design.buses), self._stamp_ns, event.identifier, payload))

    def _send(self, burst: Burst) -> None:
        bus, layout, patch = self._patches[burst.patch % len(self._patches)]
        sent = [(module.key, frame) for module in patch.modules for frame in layout.frames]
        faults: dict[int, list[str]] = {}
        for place, what in burst.faults:
            faults.setdefault(place % len(sent), []).append(what)
        shift_ns, swapped = 0, list[Wire]()
        for place, (key, frame) in enumerate(sent):
            wrong = faults.get(place, [])
            if "late" in wrong:
                shift_ns += self._period_ns
            payload = self._payload(layout, frame, patch.key, key, burst, place, wrong)
            if payload is None:
                continue
            stamp_ns = self._stamp_ns + shift_ns + place * burst.pace * self._period_ns // 1000
            if "early" in wrong:
                stamp_ns -= self._period_ns
            if "before boot" in wrong:
                stamp_ns = -burst.value
            wire = bus, stamp_ns, identifier_of(frame, patch.key, key), payload
            if "swapped" in wrong:
                swapped.append(wire)
                continue
            self._waiting += [wire] * (1 + ("twice" in wrong)) + swapped
            swapped = []
            if burst.cut == place:
                self._digest()
        self._waiting += swapped
        self._stamp_ns += shift_ns

    def _payload(
        self, layout: Layout, frame: Frame, patch: int, key: int, burst: Burst, place: int, wrong: Sequence[str]
    ) -> bytes | None:
        """None: the frame is lost, but has been counted."""
        lengths = sorted(frame.length)
        length = lengths[burst.value % len(lengths)]
        payload = bytearray(_bytes(burst.value + 7 * place if burst.value > 1 else burst.value, length))
        number = frame.sequence
        if layout.cycle is not None and layout.cycle.counter is not None and frame.name in layout.cycle.members:
            number = layout.cycle.counters[layout.cycle.members.index(frame.name)]
        if frame.time is not None:
            ticks = round(self._stamp_ns / 1e9 / frame.time.unit_s) % frame.time.turn
            payload[frame.time.offset : frame.time.end] = np.array(ticks, frame.time.dtype).tobytes()
        if number is not None:
            who = patch, key, layout.frames.index(frame)
            self._counts[who] = self._counts.get(who, 0) + burst.counts
            put_number(payload, number, self._counts[who] % number.turn)
        if frame.module_byte is not None:
            put_bits(payload, frame.module_byte, key ^ ("other module" in wrong) ^ 5 * ("stranger's length" in wrong))
        for condition in frame.when:
            if isinstance(condition, Byte):
                value = condition.value ^ (0x07 if "other header" in wrong else 0)
                payload[condition.offset] = (payload[condition.offset] & ~condition.mask | value) & 0xFF
        if "lost" in wrong:
            return None
        longest = self.pair.numpy.batch.payload_size
        if "garbage" in wrong:
            payload = bytearray(_bytes(burst.value + place, length))
        if "short" in wrong:
            del payload[burst.value % length :]
        if "long" in wrong or "stranger's length" in wrong:
            payload += bytes(1 + burst.value % 3)
        return bytes(payload[:longest])


def identifier_of(frame: Frame, patch: int, module: int) -> int:
    """The identifier of a patch's and module's frame of this kind."""
    found = 0
    for condition in frame.when:
        if isinstance(condition, Identifier):
            found |= condition.value
    for bits, key in ((frame.patch, patch), (frame.module, module)):
        if isinstance(bits, Bits) and bits.byte is None:
            found |= key << bits.shift
    return found


def put_number(payload: bytearray, number: SequenceNumber, value: int) -> None:
    """Write a number into the bits that are its own."""
    place = slice(number.offset, number.end)
    word = int(np.frombuffer(bytes(payload[place]), number.dtype)[0]) & ~number.bits
    payload[place] = np.array(word | value << number.shift & number.bits, number.dtype).tobytes()


def put_bits(payload: bytearray, bits: Bits, key: int) -> None:
    """Write a module's key into its bits of a payload byte."""
    assert bits.byte is not None
    mask = (1 << bits.width) - 1 << bits.shift
    payload[bits.byte] = payload[bits.byte] & ~mask & 0xFF | key << bits.shift & mask


def _bytes(value: int, count: int) -> bytes:
    """So many bytes, the same for the same value; the first few are what does not come by chance."""
    if value < len(_PATTERNS):
        return (_PATTERNS[value] * count)[:count]
    return random.Random(value).randbytes(count)
