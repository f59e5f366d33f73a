"""LinkerHand L6, L7, L10, L20, G20, L21, L25 and O6 on CAN: matrices or values of touch at each finger.

Wire format: the maker's linkerhand-python-sdk, and linkerhand-ros2-sdk with its table of commands. Classic CAN,
1 Mbit/s. All frames to and from a hand have one identifier, 0x27 for a right hand and 0x28 for a left one. Byte 0 is a
command; alone it is a question, which the hand answers with the same byte and data within a millisecond. It ignores
unknown questions.

* ``B0``: kind of touch (0 none, 1 values of each finger, 2 to 4 matrices, 5 and 7 matrices of the whole hand, 6 not
  over CAN).
* ``C0``: serial number, in frames ``C0 k`` with six characters each.
* ``B1 C6`` to ``B5 C6``, thumb to little finger, ``B6 C6`` the palm: twelve rows of six, a frame each: ``B1 r0`` with r
  the row, and its values. ``A4`` instead of ``C6``: ten rows of four. A hand knows one of the two.
* ``B1 17 09 01`` to ``B5 17 09 01``, ``B6 1C 14 01`` (G20, kind 5): matrices of 23 x 9 and 28 x 20 in runs of five:
  ``B1 row column`` and values, at last ``B1 FF`` with sums. Kind 7: ``0C 06`` and ``0E 10``, 12 x 6 and 14 x 16.
* ``20`` to ``23`` (L21, L25: ``90`` to ``93``): normal force, tangential force, its direction (255: none), proximity,
  of the five fingers.

The frames carry no number. A matrix is published if all its rows came, in order and soon after each other, whichever
program asked for them. Usually the hand's own program asks, and this driver sends nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware_drivers import Identifier, Link, Match, Options, Patch, Poll, operation
from skinware_drivers.bus import LARGEST_STANDARD, identifier_text
from skinware_drivers.can import CanAdapter
from skinware_drivers.can.linkerhand_touch import PARTS, TOUCH, TouchQuestion, every_layout, parts_heard
from skinware_drivers.hand import Hand
from skinware_drivers.link import Heard
from skinware_drivers.polling import ZeroWatch

RIGHT, LEFT = 0x27, 0x28
_KIND_OF_TOUCH, _SERIAL_NUMBER = 0xB0, 0xC0
_CANDIDATES = {
    1: ("fingers", "fingers_90"),
    **dict.fromkeys((2, 3, 4), ("12x6", "10x4")),
    5: ("hand_23x9",),
    7: ("hand_12x6",),
}
_UNREADABLE = {0: "it has none", 6: "not over CAN"}
_ANSWER_S, _SERIAL_S = 0.03, 0.05
_TRIES, _LONGEST_QUESTION = 2, 5
_FEWEST_ROUNDS, _SHORTEST_ROUND_S, _LONGEST_ROUND_S = 3, 0.01, 2.0


class LinkerHandOptions(Options, frozen=True):
    hands: Annotated[
        tuple[int, ...], Meta(description="identifiers of the hands; default: 0x27 and 0x28, if present")
    ] = ()
    touch: Annotated[
        Literal["auto", "12x6", "10x4", "fingers", "fingers_90", "hand_23x9", "hand_12x6"],
        Meta(
            description="matrices of this size, values of each finger (commands 20 or 90), or matrices of the whole"
            " hand with fingers of this size; auto: find out"
        ),
    ] = "auto"
    ask: Annotated[bool, Meta(description="ask the hands for their touch; only where no other program does")] = False
    period_ms: Annotated[
        Annotated[int, Meta(ge=20, le=2000)] | None,
        Meta(
            description="time between two updates, ms; default: learnt by a listener, else 50, for the whole hand 100"
        ),
    ] = None
    learn_s: Annotated[float, Meta(description="time in which a listener learns the hands, s", gt=0)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.hands)) < len(self.hands) or not all(0 < hand <= LARGEST_STANDARD for hand in self.hands):
            raise ConfigurationError(f"hands {self.hands}: give different identifiers of 1 to 0x7FF")


class _Found(NamedTuple):
    """A hand: the name of its kind of touch in ``TOUCH``, and its parts that have touch."""

    touch: str
    parts: Sequence[str]


class LinkerHandDriver(CanAdapter[LinkerHandOptions]):
    """Hands on one bus, a patch each; uid = identifier << 16 | part << 12 | taxel, parts in the order of ``PARTS``.

    Values are raw, larger for more force.
    """

    payload_size = 8
    dtype = np.uint8
    _round_s: float | None = None  # from one round of another program's questions to the next
    watch = ZeroWatch

    def __init__(self, options: LinkerHandOptions) -> None:
        super().__init__(options)
        usual = "12x6" if options.touch == "auto" else options.touch
        self._take({hand: _Found(usual, FINGERS) for hand in self._wanted})
        if options.touch == "auto":
            self.layout = every_layout(Identifier.covering(self._wanted))

    @property
    def _wanted(self) -> Sequence[int]:
        return self.options.hands or (RIGHT, LEFT)

    @property
    def polls(self) -> Sequence[Poll]:
        """Questions for all parts of all hands, each after the reply to the one before; none without ``ask``."""
        if not self.options.ask:
            return ()
        return [
            Poll(hand, one.payload, self.period_s, one.end(hand), min(one.patience_s, self.period_s))
            for hand, questions in self._questions.items()
            for one in questions
        ]

    async def describe(self, link: Link) -> Sequence[Patch]:
        found = await self._find(link, self._wanted)
        if not found:
            names = ", ".join(map(identifier_text, self._wanted))
            raise HandshakeTimeout(
                f"{link.bus_name}: no hand with touch answers at {names}"
                if self._asks(link)
                else f"{link.bus_name}: no hand sends touch at {names}, as if no program asked for it; to let this"
                " driver ask, set ask=yes"
            )
        self._take(found)
        return self.patches

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        found = {patch.key: self._found[patch.key] for patch in known}
        self._take({**found, **await self._find(link, [hand for hand in self._wanted if hand not in found])})
        return self.patches

    async def probe(self, link: Link, patch: Patch) -> bool:  # noqa: ARG002
        """Send nothing: a silent hand is asked for its touch all the time, by this or another program."""
        return False

    async def attend(self, link: Link) -> None:
        """Follow the other frames of the hands, so that they do not count as unused; warn if another program asks."""
        questions = {question.payload for questions in self._questions.values() for question in questions}
        has_warned = not self._asks(link)
        with link.follow(*(Match(patch.key) for patch in self.patches)) as others:
            while True:
                frame = await others.get()
                if not has_warned and frame.payload in questions:
                    has_warned = True
                    link.log.warning(
                        "another program asks %s for its touch, too: answers to both get mixed up, and questions"
                        " collide with answers; leave out ask=yes, and this driver shows what the other one asks for",
                        _name(frame.identifier),
                    )

    @operation(looks=True)
    async def serial_number(self, link: Link, patches: Sequence[Patch]) -> dict[str, str]:
        """Return the serial numbers of the hands."""
        found = {}
        for patch in patches:
            reply = Match(patch.key, prefix=bytes([_SERIAL_NUMBER]), shortest=3)
            frames = await link.collect(patch.key, bytes([_SERIAL_NUMBER]), reply, duration_s=_SERIAL_S)
            pieces = {frame.payload[1]: frame.payload[2:] for frame in frames}
            text = b"".join(pieces[number] for number in sorted(pieces)).decode("ascii", "replace")
            found[patch.name] = text.strip("\0 ")
        return found

    def _asks(self, link: Link) -> bool:
        return self.options.ask and not link.listen_only

    def _take(self, found: Mapping[int, _Found]) -> None:
        if len({of.touch for of in found.values()}) > 1:
            kinds = ", ".join(f"{identifier_text(hand)}: {of.touch}" for hand, of in found.items())
            raise BusError(
                f"hands of different touch on one bus ({kinds}): run a driver for each, with its option hands"
            )
        touch = TOUCH[next(iter(found.values())).touch]
        self._found = dict(found)
        self._questions = {hand: touch.questions(of.parts) for hand, of in found.items()}
        self.types = touch.types
        if self.options.period_ms is None:
            self.period_s = self._round_s or touch.period_s
        self.layout = touch.layout(Identifier.covering(list(found)))
        self.patches = [Patch(_name(hand), touch.modules(hand, of.parts), hand) for hand, of in found.items()]
        sides = {hand: Hand("left" if hand == LEFT else "right") for hand in found}
        self.geometry = Geometry.joined([touch.geometry(hand, of.parts, sides[hand]) for hand, of in found.items()])

    async def _find(self, link: Link, wanted: Sequence[int]) -> dict[int, _Found]:
        """Return those of these hands that are on the bus; a listener believes the options about them."""
        if self._asks(link):
            return {hand: of for hand in wanted if (of := await self._ask_hand(link, hand)) is not None}
        if self.options.hands and self.options.touch != "auto":
            return {hand: _Found(self.options.touch, FINGERS) for hand in wanted}
        heard = await link.listen(self.options.learn_s)
        found = self._heard(heard, wanted)
        asked = [
            heard[Heard(hand, question.payload[0], len(question.payload))]
            for hand, of in found.items()
            for question in TOUCH[of.touch].questions(of.parts)
        ]
        if (rounds := max(asked, default=0)) >= _FEWEST_ROUNDS:
            self._round_s = min(max(self.options.learn_s / rounds, _SHORTEST_ROUND_S), _LONGEST_ROUND_S)
        return found

    def _heard(self, heard: Counter[Heard], wanted: Sequence[int]) -> dict[int, _Found]:
        """Return the hands whose touch was heard, each with the kind of touch that most of its frames fit."""
        found = {}
        for hand in wanted:
            frames = {(one.first_byte, one.length): n for one, n in heard.items() if one.identifier == hand}
            known = {name: touch.known(frames) for name, touch in TOUCH.items()}
            name = max(known, key=lambda name: known[name]) if self.options.touch == "auto" else self.options.touch
            if known[name]:
                commands = {first for first, length in frames if length > _LONGEST_QUESTION}
                found[hand] = _Found(name, parts_heard(TOUCH[name], commands))
        return found

    async def _ask_hand(self, link: Link, hand: int) -> _Found | None:
        """Return the kind of touch for which this hand answers; None if it does not answer."""
        names: Sequence[str] = (self.options.touch,)
        if self.options.touch == "auto":
            names = await self._likely(link, hand)
        for name in names:
            questions = TOUCH[name].questions(PARTS)
            if await _answers(link, hand, questions[0]):
                has_palm = len(questions) == len(PARTS) and await _answers(link, hand, questions[-1])
                return _Found(name, PARTS if has_palm else FINGERS)
        return None

    async def _likely(self, link: Link, hand: int) -> Sequence[str]:
        """Return the kinds of touch that the hand may have, by its answer to ``B0``."""
        reply = Match(hand, prefix=bytes([_KIND_OF_TOUCH]), shortest=2)
        try:
            frame = await link.request(hand, bytes([_KIND_OF_TOUCH]), reply, timeout_s=_ANSWER_S, tries=_TRIES)
        except HandshakeTimeout:  # hands ignore questions that they do not know
            return tuple(TOUCH)
        kind = frame.payload[1]
        if kind in _UNREADABLE:
            raise BusError(
                f"{link.bus_name}: the touch of {_name(hand)} cannot be read: {_UNREADABLE[kind]} (kind {kind})"
            )
        return _CANDIDATES.get(kind, tuple(TOUCH))


async def _answers(link: Link, hand: int, question: TouchQuestion) -> bool:
    timeout_s = max(_ANSWER_S, question.patience_s)
    try:
        await link.request(hand, question.payload, question.end(hand), timeout_s=timeout_s, tries=_TRIES)
    except HandshakeTimeout:
        return False
    return True


def _name(hand: int) -> str:
    return {RIGHT: "right hand", LEFT: "left hand"}.get(hand, f"hand {identifier_text(hand)}")
