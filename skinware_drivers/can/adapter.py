"""The adapter that every CAN driver subclasses."""

from __future__ import annotations

from typing import ClassVar

from skinware_drivers.adapter import Adapter
from skinware_drivers.options import OptionsT


class CanAdapter(Adapter[OptionsT]):
    """One CAN bus of a driver. Frames carry 11-bit identifiers; see :class:`skinware_drivers.adapter.Adapter`."""

    medium: ClassVar[str] = "can"
