"""The base class of drivers of skins whose values a program makes."""

from __future__ import annotations

from typing import ClassVar

from skinware_drivers.adapter import Adapter
from skinware_drivers.options import OptionsT


class VirtualAdapter(Adapter[OptionsT]):
    """One emulated bus of a driver, ``--bus virtual``; see :class:`skinware_drivers.adapter.Adapter`.

    There is no wire: payloads can have any length that the layout declares.
    """

    medium: ClassVar[str] = "virtual"
