"""Read the operations that a page may ask for from JSON."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from skinware.errors import ConfigurationError
from skinware.views.looks import DEFAULT_FPS, Mode

MOST_EXACT = 32
"""Sensors whose exact values are sent, at most."""

Number = Annotated[int, msgspec.Meta(ge=0, le=2**31)]


class Next(msgspec.Struct, tag_field="op", tag="next"):
    protocol: str | None = None


class Choose(msgspec.Struct, tag_field="op", tag="look"):
    """Choose mode, quantity, scale and pace."""

    mode: Mode = "raw"
    type: str | None = None
    scale: tuple[float, float] | None = None
    fps: Annotated[float, msgspec.Meta(ge=1, le=60)] = DEFAULT_FPS

    def __post_init__(self) -> None:
        if self.scale is not None and not (all(map(math.isfinite, self.scale)) and self.scale[0] < self.scale[1]):
            raise ValueError(f"scale {list(self.scale)}: give two numbers, the lower one first")


class Exact(msgspec.Struct, tag_field="op", tag="exact"):
    """Choose the sensors whose exact values are sent, as pairs of driver and position."""

    sensors: Annotated[list[tuple[Number, Number]], msgspec.Meta(max_length=MOST_EXACT)]


class Names(msgspec.Struct, tag_field="op", tag="names"):
    """Ask for the names of the sensors of a driver's quantity."""

    driver: Number
    type: str


class Series(msgspec.Struct, tag_field="op", tag="series"):
    """Ask for the last seconds of a sensor."""

    driver: Number
    position: Number


class Tare(msgspec.Struct, tag_field="op", tag="tare"):
    """Take the present values for rest."""


class Wipe(msgspec.Struct, tag_field="op", tag="wipe"):
    """Begin a wipe test again, or leave it as it is."""

    action: Literal["start", "stop"]


class Record(msgspec.Struct, tag_field="op", tag="record"):
    action: Literal["start", "stop"]


class Replay(msgspec.Struct, tag_field="op", tag="replay"):
    """Control the replay that is shown."""

    action: Literal["pause", "resume", "step", "seek", "speed", "loop"]
    value: int | float | bool | None = None


Operation = Next | Choose | Exact | Names | Series | Tare | Wipe | Record | Replay
_DECODER = msgspec.json.Decoder(Operation)


def operation_of(text: str | bytes) -> Operation:
    """Return an operation from its JSON.

    Raises:
        ConfigurationError: this is no operation; the message says why.
    """
    try:
        operation: Operation = _DECODER.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:  # a ValidationError is a DecodeError
        raise ConfigurationError(str(error)) from None
    return operation
