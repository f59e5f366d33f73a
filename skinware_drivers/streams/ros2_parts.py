"""Make modules of taxels of the fields of a message, by rules such as a map file has."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.sensor_types import CATALOGUE, MAX_NAME_BYTES, SensorType
from skinware.status import Status
from skinware.text import printable
from skinware_drivers.streams.cdr import CdrMessage, Indices, gathered

MOST_VALUES = 4096
"""Values of a part; a field with more becomes several."""
_MOST_OF_A_MESSAGE = 1 << 16
_VENDOR = 0x20520 << 12
"""The vendor of quantities that the catalogue lacks; their numbers follow from their names."""
_PLACEHOLDER = re.compile(r"\{([\w.]+)\}")
_STAMP_NS = 10_000
_LONGEST_TEXT, _LONGEST_NAME, _BEGINNING = 48, 32, 12

Places = npt.NDArray[np.int64]
"""First byte of each number of a column, in a sample."""


class FieldRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The meaning of a field, as in a map file.

    Attributes:
        field: with the values, as ``hand.palm``; several: one for each value of a taxel.
        quantity: a type of the catalogue, as ``pressure`` or ``force_x``, or another name; for each field.
        unit: of the values; one, or one for each field.
        patch: default: the topic.
        module: its name; ``{sensors.name}`` stands for the contents of a field. Default: the name of the field.
        taxels: rows and columns, or their number; default: as many as come.
        each: a sequence whose elements each are a module.
        position: fields with x, y and z of each taxel, m.
        normal: fields with the components of its normal.
        status: a field that is not 0 where a value is doubtful; with ``!`` before it, 0.
        number: a field that the publisher counts up with each message; missing numbers are counted.
    """

    field: str | tuple[str, ...]
    quantity: str | tuple[str, ...] = "pressure"
    unit: str | tuple[str, ...] = "counts"
    patch: str = ""
    module: str = ""
    taxels: int | tuple[int, int] | None = None
    each: str = ""
    position: tuple[str, str, str] | None = None
    normal: tuple[str, str, str] | None = None
    status: str = ""
    number: str = ""

    @property
    def fields(self) -> tuple[str, ...]:
        return (self.field,) if isinstance(self.field, str) else self.field


@dataclass(frozen=True)
class ModulePart:
    """The values of a module in a message.

    Attributes:
        types: of each value of a taxel.
        places: of the values of all taxels, for each type.
        dtypes: of each type, with byte order.
        doubt: places, dtype and whether 0 is doubtful, of a number for each taxel.
        number: place and dtype of the message's number, and bytes of it that :meth:`body` has.
        position_m: (taxels, 3) float64; None: not known.
        normal: (taxels, 3) float64 of any length but 0; None: not known.
        frame: coordinate frame of the positions.
    """

    patch: str
    name: str
    kind: str
    types: tuple[SensorType, ...]
    places: tuple[Places, ...]
    dtypes: tuple[str, ...]
    doubt: tuple[Places, str, bool] | None = None
    number: tuple[int, str, int] | None = None
    position_m: npt.NDArray[np.float64] | None = None
    normal: npt.NDArray[np.float64] | None = None
    frame: str = ""

    @property
    def taxels(self) -> int:
        return len(self.places[0])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Little-endian, of all values."""
        return np.result_type(*self.dtypes).newbyteorder("<")

    @property
    def form(self) -> tuple[Any, ...]:
        """Everything that is the same as long as the values are of the same sensors."""
        return self.kind, self.types, self.taxels, self.dtype, self.doubt is not None, self.number and self.number[1:]

    def body(self, sample: bytes) -> bytes:
        """Return the values taxel by taxel, then a status byte for each and the message's number, if it has these."""
        columns = gathered(sample, self.places, self.dtypes)
        body = np.stack(columns, axis=1).astype(self.dtype).tobytes()
        if self.doubt is not None:
            places, dtype, is_inverted = self.doubt
            [given] = gathered(sample, [places], [dtype])
            status = np.where((given == 0) == is_inverted, int(Status.SUSPECT), 0).astype(np.uint8)
            body += np.repeat(status, len(self.types)).tobytes()
        if self.number is not None:
            place, dtype, size = self.number
            body += np.frombuffer(sample, dtype, 1, place).astype(f"<u{size}").tobytes()
        return body

    def pieces(self) -> list[ModulePart]:
        """Return this part, or parts of at most ``MOST_VALUES`` values, of whole rows if it has any; names are cut."""
        columns = int(self.kind.partition("x")[2] or 1) if re.fullmatch(r"\d+x\d+", self.kind) else 1
        most = max(1, MOST_VALUES // len(self.types) // columns) * columns
        if self.taxels <= most:
            return [replace(self, patch=_short(self.patch), name=_short(self.name))]
        return [self._piece(first, min(first + most, self.taxels), columns) for first in range(0, self.taxels, most)]

    def _piece(self, first: int, end: int, columns: int) -> ModulePart:
        rows = slice(first, end)
        return replace(
            self,
            patch=_short(self.patch),
            name=_short(f"{self.name} {first}-{end - 1}"),
            kind=f"{(end - first) // columns}x{columns}" if columns > 1 else self.kind,
            places=tuple(each[rows] for each in self.places),
            doubt=None if self.doubt is None else (self.doubt[0][rows], *self.doubt[1:]),
            position_m=None if self.position_m is None else self.position_m[rows],
            normal=None if self.normal is None else self.normal[rows],
        )


class Plan:
    """The places of a message's values, which are the same in samples with the same lengths and texts.

    Attributes:
        messages: heard since this was set to 0.
        listed: messages until one is passed on to those that want to learn it.
    """

    def __init__(self, message: CdrMessage, parts: Sequence[ModulePart]) -> None:
        pieces = [piece for part in parts for piece in part.pieces()]
        by_name = {(each.patch, each.name): each for each in reversed(pieces)}
        self.parts: Sequence[ModulePart] = list(by_name.values())[::-1]
        self.messages = self.listed = 0
        self._size, self._fixed = len(message.sample), message.fixed
        self._as = np.frombuffer(message.sample, np.uint8)[self._fixed]
        self._stamp = [message.numbers.get(f"header.stamp.{of}", {}).get(()) for of in ("sec", "nanosec")]

    def fits(self, sample: bytes) -> bool:
        return len(sample) == self._size and np.array_equal(np.frombuffer(sample, np.uint8)[self._fixed], self._as)

    def period_s(self, duration_s: float) -> float:
        """Return the time between messages, by how many came; 0 if none was counted, twice the duration if one was."""
        return duration_s / max(self.messages - 1, 0.5) if self.messages else 0.0

    def stamp(self, sample: bytes) -> bytes:
        """Return the time of the header as a source's time; empty if there is none."""
        seconds, nanoseconds = (0 if each is None else int(each.of(sample)[0]) for each in self._stamp)
        time_ns = seconds * NS_PER_S + nanoseconds
        return (time_ns // _STAMP_NS & 0xFFFF_FFFF).to_bytes(4, "little") if time_ns > 0 else b""


Making = Callable[[CdrMessage, str], Sequence[ModulePart]]
"""Returns the parts of a message on a topic; raises ValueError if its contents make no sense."""


def sensor_type(quantity: str, unit: str) -> SensorType:
    """Return the type of a quantity; one that the catalogue lacks gets a number by its name."""
    known = CATALOGUE.get(quantity)
    if known is not None:
        return known.measured(unit=unit)
    quantity = _name(quantity).encode()[:MAX_NAME_BYTES].decode(errors="ignore") or "value"
    return SensorType(quantity, _VENDOR | 1 + zlib.crc32(quantity.encode()) % 0xFFF, unit)


def check_count(count: int) -> None:
    """Refuse more values than a message can show.

    Raises:
        ValueError: there are more.
    """
    if count > _MOST_OF_A_MESSAGE:
        raise ValueError(f"{count} values, of which at most {_MOST_OF_A_MESSAGE} can be shown: is it a camera?")


def by_rules(*rules: FieldRule) -> Making:
    """Return what makes parts by rules; the first rule that finds values of a module counts."""

    def parts(message: CdrMessage, topic: str) -> Sequence[ModulePart]:
        found: dict[tuple[str, str], ModulePart] = {}
        for rule in rules:
            for key, part in _of_rule(rule, message, topic).items():
                found.setdefault(key, part)
        return list(found.values())

    return parts


def columns_of(message: CdrMessage, names: Sequence[str], within: Indices = ()) -> tuple[list[Places], list[str]]:
    """Return places and dtype of the numbers of each field, within an element of a sequence.

    Raises:
        ValueError: there is no such field with numbers, or they have different lengths.
    """
    places, dtypes = [], []
    for name in names:
        if name not in message.numbers and name.partition(".")[0] not in {*message.counts}:
            raise ValueError(f"no field {name!r} with numbers; there are {', '.join(message.numbers)}")
        inner = [numbers for at, numbers in message.numbers.get(name, {}).items() if at[: len(within)] == within]
        places.append(np.concatenate([numbers.places for numbers in inner] or [np.zeros(0, np.int64)]))
        dtypes.append(inner[0].dtype if inner else "u1")
    if len({len(each) for each in places}) > 1:
        raise ValueError(f"{' and '.join(names)} have {' and '.join(str(len(each)) for each in places)} values")
    return places, dtypes


def frame_of(message: CdrMessage, topic: str) -> str:
    return _name(message.texts.get("header.frame_id", {}).get((), "")) or topic


def _of_rule(rule: FieldRule, message: CdrMessage, topic: str) -> dict[tuple[str, str], ModulePart]:
    names = rule.fields
    quantities = (rule.quantity,) * len(names) if isinstance(rule.quantity, str) else rule.quantity
    units = (rule.unit,) * len(names) if isinstance(rule.unit, str) else rule.unit
    if len(quantities) != len(names) or len(units) != len(names):
        raise ValueError(f"give a quantity and a unit for each of the {len(names)} fields {', '.join(names)}")
    types = tuple(sensor_type(quantity, unit) for quantity, unit in zip(quantities, units, strict=True))
    found: dict[tuple[str, str], ModulePart] = {}
    for within in _elements(rule.each, message):
        places, dtypes = columns_of(message, names, within)
        count = len(places[0])
        check_count(count * len(names))
        if not count:
            continue
        if rule.taxels is not None and int(np.prod(rule.taxels)) != count:
            raise ValueError(f"{names[0]} has {count} values, not {rule.taxels} as the map says")
        kind = "x".join(map(str, rule.taxels)) if isinstance(rule.taxels, tuple) else "taxels"
        key = rule.patch or topic, _module_name(rule, message, within)
        while key in found:
            key = key[0], f"{key[1]} again"
        found[key] = ModulePart(
            *key,
            kind,
            types,
            tuple(places),
            tuple(dtypes),
            _doubt(rule.status, message, within, count),
            _number(rule.number, message, within),
            position_m=_vectors(message, rule.position, within, count),
            normal=_vectors(message, rule.normal, within, count),
            frame=frame_of(message, topic),
        )
    return found


def _elements(each: str, message: CdrMessage) -> Iterator[Indices]:
    if not each:
        yield ()
    for within, count in message.counts.get(each, {}).items():
        yield from ((*within, element) for element in range(count))


def _module_name(rule: FieldRule, message: CdrMessage, within: Indices) -> str:
    def contents(match: re.Match[str]) -> str:
        if match[1] in message.texts:
            return message.texts[match[1]].get(within, "")
        return str(message.number(match[1], within)) if within in message.numbers.get(match[1], {}) else ""

    told = _name(_PLACEHOLDER.sub(contents, rule.module))
    return told or " ".join([rule.each or rule.fields[0].rpartition(".")[2], *map(str, within)])


def _vectors(
    message: CdrMessage, names: tuple[str, str, str] | None, within: Indices, count: int
) -> npt.NDArray[np.float64] | None:
    """Return (count, 3) float64 of three fields, NaN where one is not finite; None if there are no such fields."""
    if names is None:
        return None
    places, dtypes = columns_of(message, names, within)
    if len(places[0]) != count:
        raise ValueError(f"{names[0]} has {len(places[0])} values for {count} taxels")
    return vectors(message.sample, places, dtypes)


def vectors(sample: bytes, places: Sequence[Places], dtypes: Sequence[str]) -> npt.NDArray[np.float64]:
    """Return (n, 3) float64 of three columns, NaN as a whole where a number is not finite."""
    found = np.stack(gathered(sample, places, dtypes), axis=1).astype(np.float64)
    return np.where(np.isfinite(found).all(axis=1, keepdims=True), found, np.nan)


def _doubt(status: str, message: CdrMessage, within: Indices, count: int) -> tuple[Places, str, bool] | None:
    if not status:
        return None
    [places], [dtype] = columns_of(message, [status.removeprefix("!")], within)
    if len(places) not in (1, count):
        raise ValueError(f"{status} has {len(places)} values for {count} taxels")
    return np.broadcast_to(places, count), dtype, status.startswith("!")


def _number(name: str, message: CdrMessage, within: Indices) -> tuple[int, str, int] | None:
    if not name:
        return None
    found = message.numbers.get(name, {})
    number = found.get(within) or found.get(())
    if number is None or number.length != 1 or number.dtype[1] == "f":
        raise ValueError(f"{name} is no single whole number")
    return number.start, number.dtype, min(np.dtype(number.dtype).itemsize, 4)


def _name(text: str) -> str:
    return printable(text).strip().encode()[:_LONGEST_TEXT].decode(errors="ignore")


def _short(name: str) -> str:
    """Return a name of at most 32 bytes; a longer one keeps its beginning and its end."""
    data = name.encode()
    if len(data) <= _LONGEST_NAME:
        return name
    return (
        f"{data[:_BEGINNING].decode(errors='ignore')}~{data[_BEGINNING + 1 - _LONGEST_NAME :].decode(errors='ignore')}"
    )
