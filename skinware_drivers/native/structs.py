"""The structures that C and Python share, read from the headers of the C code. Every field has 8 bytes."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from skinware_drivers.wire_tap import Kept

_HEADERS = ("path.h", "inside.h", "framing.h", "flow.h")
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_STRUCT = re.compile(r"^struct (\w+) \{(.*?)^\};", re.DOTALL | re.MULTILINE)
_FUNCTION = re.compile(r"(\w+) \(\*(\w+)\)\((.*)\)", re.DOTALL)
_VARIABLES = re.compile(r"(?:const )?(?:struct )?(\w+) (.*)", re.DOTALL)

_TEXT = _COMMENT.sub("", "".join((Path(__file__).with_name(name)).read_text() for name in _HEADERS))
_BODIES: dict[str, str] = dict(_STRUCT.findall(_TEXT))
_KINDS: dict[str, Any] = {"void": None, "int64_t": ctypes.c_int64, "double": ctypes.c_double}  # but pointers

StructT = TypeVar("StructT", bound=ctypes.Structure)


def _from_header(cls: type[StructT]) -> type[StructT]:
    """Give a class the fields of its struct in C: ``AskedRead`` those of ``struct asked_read``."""
    name = re.sub(r"(?<!^)([A-Z])", r"_\1", cls.__name__).lower()
    cls._fields_ = [field for one in _BODIES[name].split(";") if one.strip() for field in _fields(one.strip())]
    _KINDS[name] = cls
    return cls


def _fields(declaration: str) -> Iterator[tuple[str, Any]]:
    if function := _FUNCTION.fullmatch(declaration):
        returned, name, parameters = function.groups()
        kinds = [] if parameters == "void" else [_kind_of(parameter) for parameter in parameters.split(",")]
        yield name, ctypes.CFUNCTYPE(_KINDS[returned], *kinds)
    elif variables := _VARIABLES.fullmatch(declaration):
        for variable in variables[2].split(","):
            yield variable.strip(" *"), _KINDS[variables[1]] if "*" not in variable else ctypes.c_void_p


def _kind_of(parameter: str) -> Any:
    return ctypes.c_void_p if "*" in parameter else _KINDS[parameter.split()[-2]]


@_from_header
class ByteCondition(ctypes.Structure):
    """A condition on a payload byte."""


@_from_header
class IdentifierCondition(ctypes.Structure):
    """A condition on an identifier."""


@_from_header
class Field(ctypes.Structure):
    """Bits of an identifier."""


@_from_header
class Form(ctypes.Structure):
    """29-bit identifiers of one bus that are built alike."""


@_from_header
class Number(ctypes.Structure):
    """A number in a payload that a device counts up."""


@_from_header
class Run(ctypes.Structure):
    """Values that lie side by side in a payload."""


@_from_header
class ChannelBit(ctypes.Structure):
    """A bit of a word that flags one channel."""


@_from_header
class Flag(ctypes.Structure):
    """A rule that sets status bits."""


@_from_header
class Kind(ctypes.Structure):
    """A kind of frame."""


@_from_header
class Assembly(ctypes.Structure):
    """The frames that make one update of a module."""


@_from_header
class Cycle(ctypes.Structure):
    """Frames that only count together."""


@_from_header
class Batch(ctypes.Structure):
    """A :class:`skinware_drivers.bus.FrameBatch`."""


@_from_header
class Columns(ctypes.Structure):
    """The places of the columns in a slot."""


@_from_header
class Hooks(ctypes.Structure):
    """Functions of Python that C calls."""


@_from_header
class Plan(ctypes.Structure):
    """All tables and arrays of one generation."""


@_from_header
class Words(ctypes.Structure):
    """The numbers that Python reads and sets between calls."""


@_from_header
class Update(ctypes.Structure):
    """The beginning of an update; its sensors (int32), values and status (uint8) follow."""


@_from_header
class Checksum(ctypes.Structure):
    """How a checksum is computed; size 0: there is none."""


@_from_header
class WireField(ctypes.Structure):
    """A whole number in the header of a frame; size 0: there is none."""


@_from_header
class Framing(ctypes.Structure):
    """How frames lie in a stream of bytes."""


@_from_header
class Reading(ctypes.Structure):
    """When the bytes of a stream up to a place came."""


@_from_header
class Stream(ctypes.Structure):
    """A stream of bytes in which C finds frames."""


@_from_header
class AskedBlock(ctypes.Structure):
    """Registers that make one frame."""


@_from_header
class AskedRead(ctypes.Structure):
    """One question for registers, and the beginning of its reply."""


@_from_header
class Asker(ctypes.Structure):
    """A Modbus master."""


@_from_header
class Source(ctypes.Structure):
    """A socket, a serial line or a Modbus master that C reads."""


@_from_header
class Flow(ctypes.Structure):
    """The loop that takes, publishes and rests."""


_MEASURED: tuple[type[ctypes.Structure], ...] = (
    *(Plan, Words, Batch, Kind, Flag, Run, Form, Cycle, Number, Assembly, Flow, Source, Framing, Stream),
    *(Asker, AskedRead, AskedBlock, Kept, Update),
)
SIZES = tuple(map(ctypes.sizeof, _MEASURED))
"""The sizes that ``skinware_path_size`` returns, if the library was compiled with these headers."""


class Arrays:
    """Memory that C code refers to by address; it is kept as long as this object."""

    def __init__(self) -> None:
        self._kept: list[object] = []

    def at(self, array: npt.NDArray[Any]) -> int:
        """Return the address of an array that Python goes on using.

        Raises:
            ValueError: its elements do not lie one after the other.
        """
        if not array.flags.c_contiguous:
            raise ValueError(f"an array of {array.shape} {array.dtype} whose elements lie apart")
        self._kept.append(array)
        return array.ctypes.data

    def of(self, values: npt.ArrayLike, dtype: npt.DTypeLike) -> int:
        return self.at(np.array(values, dtype, order="C"))

    def structs(self, kind: type[Any], rows: Iterable[Any]) -> tuple[int, int]:
        """Return the number and the address of structs."""
        found = list(rows)
        memory = (kind * max(1, len(found)))(*found)
        self._kept.append(memory)
        return len(found), ctypes.addressof(memory)
