"""The words that declare the meaning of frames. Nothing here runs per frame: see ``decoding``.

A layout is a list of :class:`Frame`. Each declares *when* a frame on the wire is of its kind, to which module it
belongs (*key*), and what its bytes are (*values*, *flags*, *sequence*). A :class:`Cycle` declares frames that only
count together.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.status import LONGEST_PERIOD_S
from skinware_drivers.bus import check_identifier
from skinware_drivers.fields import AnyFlag, Bits, Byte, Condition, DeviceTime, Flag, Identifier, Packed, SequenceNumber

MOST_FRAMES = 200
"""Kinds of frame that a driver can have, over all its buses."""
MOST_MEMBERS, MOST_IN_ANY_ORDER = 128, 32
"""Frames that a cycle can have: in a given order, and in any other."""
_KEY_BITS = 29
_FEWEST_COUNTS = 4


@dataclass(frozen=True)
class Values:
    """The place of sensor values in a payload.

    Attributes:
        offset: first byte.
        dtype: numpy dtype with byte order (``"<u2"``), or :class:`Packed`.
        count: number of values.
        to: channel of the module that each value belongs to, None = dropped; default: 0, 1, 2 ...
    """

    offset: int
    dtype: str | Packed
    count: int
    to: Sequence[int | None] | None = None

    @property
    def channels(self) -> tuple[int | None, ...]:
        """Channel of each value, None = dropped."""
        return tuple(range(self.count)) if self.to is None else tuple(self.to)

    @property
    def end(self) -> int:
        """One past the last byte."""
        if isinstance(self.dtype, Packed):
            return self.offset + -(-(self.dtype.skip + self.count * self.dtype.bits) // 8)
        return self.offset + self.count * np.dtype(self.dtype).itemsize


@dataclass(frozen=True)
class Expand:
    """A vectorised function that reads payloads which ``Values`` cannot describe: run lengths, nibble maps, text.

    ``function(payload, length)`` is called with (n, size) uint8 and (n,) uint8 and returns three arrays of equal
    length: the row of ``payload``, the channel, and the value.

    It is called with anything that comes over the wire, also garbage. A frame for which it raises, or returns a value
    that the dtype cannot hold, is counted as bad content and not shown.

    Attributes:
        function: see above.
        to: the channels that it can return; None: any. If other frames fill the same module, it determines which
            sensors this kind of frame keeps fresh.
    """

    function: Callable[
        [npt.NDArray[np.uint8], npt.NDArray[np.uint8]],
        tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[Any]],
    ]
    to: Sequence[int] | None = None


@dataclass(frozen=True)
class Frame:
    """One kind of frame.

    Attributes:
        name: for the cycle and for messages.
        when: conditions that must all hold; none: every frame of the bus with an 11-bit identifier is of this kind.
        length: correct payload lengths; frames of other lengths are counted and not shown.
        values: the places of the values, in one run or in several; none: only the status of other modules is in it.
        patch: bit field of the identifier that names the patch; or the key of the only patch that sends this frame;
            None: the bus has one patch.
        module: bit field that names the module within the patch; or the key of the only module that it is of; None:
            the patch has one module.
        flags: rules that set status bits.
        sequence: sequence number that the frames of a cycle do not share (see :class:`Cycle`).
        time: the device's own time, if the frame has it.
        period_s: nominal time between two of these frames of a module, if it is longer than the driver's: their sensors
            are stale after three of these periods.
    """

    name: str
    when: Sequence[Condition] = ()
    length: Sequence[int] = ()
    values: Values | Sequence[Values] | Expand = ()
    patch: Bits | int | None = None
    module: Bits | int | None = None
    flags: Sequence[AnyFlag] = ()
    sequence: SequenceNumber | None = None
    time: DeviceTime | None = None
    period_s: float | None = None

    def __post_init__(self) -> None:
        for what in ("when", "length"):
            if not isinstance(getattr(self, what), Collection):
                raise ConfigurationError(f"frame {self.name!r}: `{what}` is a list: write {what}=[...]")

    @property
    def runs(self) -> Sequence[Values]:
        """The runs of values; empty for a frame that is expanded."""
        if isinstance(self.values, Expand):
            return ()
        return (self.values,) if isinstance(self.values, Values) else self.values

    @property
    def module_flags(self) -> Sequence[Flag]:
        """The flags of other modules."""
        return [flag for flag in self.flags if isinstance(flag, Flag) and flag.each_module]

    @property
    def module_byte(self) -> Bits | None:
        """The field of the payload that names the module; None: the identifier names it."""
        return self.module if isinstance(self.module, Bits) and self.module.byte is not None else None

    @property
    def extended(self) -> bool:
        """Whether its identifiers have 29 bits."""
        return any(isinstance(c, Identifier) and c.extended for c in self.when)


@dataclass(frozen=True)
class Cycle:
    """Frames that together are one coherent update of a module; it is shown only if all of them arrived.

    With a ``counter``, frames of different cycles are never joined. Without one, only order and time separate cycles:
    see :doc:`/explanation/layout` for the cases in which that fails.

    Attributes:
        members: names of the frames, in order.
        within: the members must follow each other without any other frame of the same ``patch`` (or ``module``)
            in between.
        order: ``given``: in the order of ``members``; ``any``: each once; ``ends_with``: any order, but the last
            member last.
        maximum_age_s: longest time from the first to the last of them. Two cycles must not fit into it: it is shorter
            than a period (``any``: half a period), or than as many periods as the counter has values.
        counter: the number that all frames of a cycle share, and that changes with each cycle of the module (or
            patch): one field that all members have, or one for each member.
        period_s: nominal time from one cycle to the next, of the modules that are the fastest; default: the driver's.
    """

    members: Sequence[str]
    maximum_age_s: float
    within: Literal["patch", "module"] = "module"
    order: Literal["given", "any", "ends_with"] = "given"
    counter: SequenceNumber | Sequence[SequenceNumber] | None = None
    period_s: float | None = None

    @property
    def counters(self) -> Sequence[SequenceNumber]:
        """The counter's field in each member; empty without one."""
        if self.counter is None:
            return ()
        return [self.counter] * len(self.members) if isinstance(self.counter, SequenceNumber) else self.counter

    @property
    def turn(self) -> int:
        """Cycles after which one looks like this again: 1 without a counter."""
        return self.counters[0].turn if self.counters else 1

    @property
    def reach_s(self) -> float:
        """The time that must be shorter than ``turn`` periods, or two cycles fit into ``maximum_age_s``, s.

        In a given order, the last frame must be from the end of a cycle and the first from the beginning of one, which
        are a period apart or more. In any order, they can be the end of one cycle and the beginning of the next.
        """
        return 2 * self.maximum_age_s if self.order == "any" else self.maximum_age_s


@dataclass(frozen=True)
class Layout:
    """All frames of a device, and the cycle that some of them form.

    Attributes:
        frames: kinds of frame.
        cycle: of some of them; None: each is shown by itself.
        more_cycles: of others of them, if not all modules send the same frames.

    Raises:
        ConfigurationError: the layout cannot be decoded; the message names the frame.
    """

    frames: Sequence[Frame]
    cycle: Cycle | None = None
    more_cycles: Sequence[Cycle] = ()

    def __post_init__(self) -> None:
        names = [frame.name for frame in self.frames]
        if len(set(names)) < len(names) or not 1 <= len(names) <= MOST_FRAMES:
            raise ConfigurationError(f"a layout has 1 to {MOST_FRAMES} frames of different names, not {names}")
        for frame in self.frames:
            _check_frame(frame)
        said = [
            (key, flag.status) for frame in self.frames for flag in frame.module_flags for key, _ in flag.each_module
        ]
        if len(set(said)) < len(said):
            raise ConfigurationError("`each_module`: one bit says whether a module has a status, and there are several")
        if len({(frame.time.unit_s, frame.time.turn) for frame in self.frames if frame.time is not None}) > 1:
            raise ConfigurationError("the times of a device's frames come from one clock: give one unit and one modulo")
        taken: set[str] = set()
        for cycle in self.cycles:
            members = list(cycle.members)
            if len(set(members)) < len(members) or not set(members) <= set(names) or len(members) < 2:
                raise ConfigurationError(f"cycle of {members}: name at least two different frames of {names}")
            if taken & set(members):
                raise ConfigurationError(f"frames {sorted(taken & set(members))} are members of two cycles")
            most = MOST_MEMBERS if cycle.order == "given" else MOST_IN_ANY_ORDER
            if len(members) > most:
                raise ConfigurationError(
                    f"a cycle of {len(members)} frames: in the order {cycle.order!r} give at most {most}"
                )
            taken |= set(members)
            if any(self.frames[names.index(name)].module_flags for name in members):
                raise ConfigurationError(f"a cycle of {members}: a frame with `each_module` is shown by itself")
            _check_counters(cycle, [self.frames[names.index(name)] for name in members])

    @property
    def cycles(self) -> Sequence[Cycle]:
        """All cycles; empty without one."""
        return (*(() if self.cycle is None else (self.cycle,)), *self.more_cycles)

    @property
    def cycle_length(self) -> int:
        """Number of frames in the cycle; 1 without one."""
        return len(self.cycle.members) if self.cycle else 1

    @property
    def payload_size(self) -> int:
        """Longest payload, rounded up to what a batch row holds."""
        longest = max(max(frame.length) for frame in self.frames)
        return 8 if longest <= 8 else -(-longest // 8) * 8


def _check_frame(frame: Frame) -> None:
    def refuse(why: str) -> ConfigurationError:
        return ConfigurationError(f"frame {frame.name!r}: {why}")

    if not frame.length:
        raise refuse("say which payload lengths are right")
    if not isinstance(frame.values, Expand) and not frame.runs and not frame.module_flags:
        raise refuse("it has no values")
    for values in frame.runs:
        if len(values.channels) != values.count:
            raise refuse(f"`count` is {values.count}, but the length of `to` is {len(values.channels)}")
        if values.end > min(frame.length):
            raise refuse(f"values end at byte {values.end}, the shortest right payload has {min(frame.length)}")
        if isinstance(values.dtype, Packed) and not 0 <= values.dtype.skip < 8:
            raise refuse(f"{values.dtype.skip} bits before the first value: give 0 to 7, and the first byte as offset")
    for name, key in (("patch", frame.patch), ("module", frame.module)):
        if isinstance(key, Bits) and not (key.width >= 1 and 0 <= key.shift <= _KEY_BITS - key.width):
            raise refuse(f"{name}: an identifier has at most {_KEY_BITS} bits, not {key.width} from bit {key.shift} on")
    if isinstance(frame.patch, Bits) and frame.patch.byte is not None:
        raise refuse("a patch is named by bits of the identifier, not of the payload")
    if frame.module_byte is not None and not 1 <= frame.module_byte.width <= 8:
        raise refuse("a module's key in the payload has 1 to 8 bits")
    if frame.extended and not all(c.extended for c in frame.when if isinstance(c, Identifier)):
        raise refuse("its identifiers have either 11 bits or 29: write EXTENDED_FLAG in all conditions or in none")
    for condition in frame.when:
        if isinstance(condition, Identifier):
            try:
                check_identifier(condition.value)
            except ConfigurationError as error:
                raise refuse(str(error)) from None
        if isinstance(condition, Identifier) and condition.value & ~condition.mask:
            raise refuse(
                f"identifier 0x{condition.value:X} has bits outside its mask 0x{condition.mask:X}: none matches"
            )
        if isinstance(condition, Byte) and condition.offset >= min(frame.length):
            raise refuse(f"byte {condition.offset} is not in every right payload")
    if frame.sequence is not None and frame.sequence.wrong(min(frame.length)):
        raise refuse(frame.sequence.wrong(min(frame.length)))
    for flag in frame.flags:
        if isinstance(flag, Flag):
            word = np.dtype(flag.dtype)
            largest = (1 << 8 * word.itemsize) - 1
            fits = all(0 <= shift < 8 * word.itemsize for _, shift in (*flag.each, *flag.each_module))
            if word.kind != "u" or not fits or not (0 <= flag.mask <= largest and 0 <= flag.normal <= largest):
                raise refuse(
                    f"a flag's `mask`, `each`, `each_module` and `normal` are bits of an unsigned word, not of"
                    f" {flag.dtype!r}: {flag}"
                )
    if frame.period_s is not None and not 0 < frame.period_s <= LONGEST_PERIOD_S:
        raise refuse(f"period_s = {frame.period_s}: give more than 0, at most {LONGEST_PERIOD_S:g}")
    if frame.time is not None and frame.time.end > min(frame.length):
        raise refuse("the device's time is not in every right payload")


def _check_counters(cycle: Cycle, members: Sequence[Frame]) -> None:
    counters = cycle.counters
    if not counters:
        return
    if len(counters) != len(members):
        raise ConfigurationError("the counter of a cycle: give one field, or one for each member")
    for counter, frame in zip(counters, members, strict=True):
        wrong = counter.wrong(min(frame.length))
        if wrong:
            raise ConfigurationError(f"frame {frame.name!r}, counter of its cycle: {wrong}")
        if frame.sequence is not None:
            raise ConfigurationError(
                f"frame {frame.name!r} has a sequence number beside the counter of its cycle: leave it out"
            )
    if len({counter.turn for counter in counters}) > 1:
        raise ConfigurationError("the counter of a cycle: its fields must be of the same modulo")
    if cycle.turn < _FEWEST_COUNTS:
        raise ConfigurationError(
            f"the counter of a cycle has {cycle.turn} values: two lost cycles look like none; it needs {_FEWEST_COUNTS}"
        )
