"""What files of arrays say of themselves, as JSON: their format, whose arrays they have, what happened meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.conversion.tables import Source, Table
from skinware.errors import BadRecording
from skinware.transfer.generation import Generation

FORMAT, VERSION = "skinware-arrays", 1


class TableText(msgspec.Struct, frozen=True):
    """A table in a file of arrays.

    Attributes:
        name: of the table; its arrays are in there under it.
        service: what it is of.
        units: of its arrays that have one, by name.
    """

    name: str
    service: str
    units: dict[str, str] = {}


class Description(msgspec.Struct, frozen=True):
    """What a file of arrays says of itself.

    Attributes:
        format: :data:`FORMAT`.
        version: of it.
        start_ns: when the recording began, ns since 1970.
        tables: in it.
        events: what happened to services.
        clock: both clocks of the machine at the same moments.
    """

    format: str
    version: int
    start_ns: int = 0
    tables: tuple[TableText, ...] = ()
    events: list[dict[str, Any]] = []
    clock: list[dict[str, Any]] = []

    def to_json(self) -> bytes:
        return msgspec.json.encode(self)


def described(source: Source, units: Sequence[dict[str, str]]) -> Description:
    tables = [TableText(table.name, table.service, of) for table, of in zip(source.tables, units, strict=True)]
    return Description(FORMAT, VERSION, source.start_ns, tuple(tables), source.events, source.clock)


def description_of(data: bytes, where: str) -> Description:
    """What a file says of itself.

    Args:
        data: JSON.
        where: for messages.

    Raises:
        BadRecording: it is not of this format, or of a newer version.
    """
    try:
        description = msgspec.json.decode(data, type=Description)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise BadRecording(f"{where}: not arrays of a recording ({error})") from None
    if description.format != FORMAT:
        raise BadRecording(f"{where}: not arrays of a recording (format {description.format!r})")
    if description.version > VERSION:
        raise BadRecording(f"{where}: written by a newer version ({description.version}): update skinware to read it")
    if not all(isinstance(each.get("log_time_ns"), int) for each in [*description.events, *description.clock]):
        raise BadRecording(f"{where}: damaged (an event without its time)")
    return description


def heads_of(table: Table) -> npt.NDArray[np.uint8]:
    """(generations, bytes): what the frames of each generation of a table are made of."""
    return np.array([np.frombuffer(generation.head, np.uint8) for generation in table.generations])


def generations_of(heads: npt.NDArray[Any], service: str, where: str) -> list[Generation]:
    """The generations of a table that :func:`heads_of` gave.

    Raises:
        BadRecording: they are none.
    """
    if heads.ndim != 2 or heads.dtype != np.uint8 or not len(heads):
        raise BadRecording(f"{where}: what the frames of {service!r} are made of is missing")
    generations = [Generation(row.tobytes(), service) for row in heads]
    if len({generation.digest for generation in generations}) > 1:
        raise BadRecording(f"{where}: generations of {service!r} with different columns in one table")
    return generations
