"""CAN: buses, the adapter that drivers of CAN devices subclass, and the drivers of skins that hang on CAN."""

from skinware_drivers.can.adapter import CanAdapter

__all__ = ["CanAdapter"]
