"""CAN: the adapter that drivers of CAN devices subclass, the buses, and the drivers themselves."""

from __future__ import annotations

from typing import ClassVar

from skinware_drivers.adapter import Adapter
from skinware_drivers.options import OptionsT

__all__ = ["CanAdapter"]


class CanAdapter(Adapter[OptionsT]):
    """One CAN bus of a driver; see :class:`skinware_drivers.adapter.Adapter`.

    Identifiers have 11 bits, or 29 with ``EXTENDED_FLAG``.
    """

    medium: ClassVar[str] = "can"
