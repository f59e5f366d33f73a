"""Emulated hardware, in this process or on a real bus: emulators and their base classes."""

from skinware_drivers.adapter import VirtualAdapter
from skinware_drivers.virtual.device import Device, EmulatorOptions
from skinware_drivers.virtual.emulator import CanFrame, Emulator, Places, on_a_grid, on_pads
from skinware_drivers.virtual.serial_device import ModbusEmulator, SerialEmulator, SerialEmulatorOptions, cut_packets

__all__ = [
    "CanFrame",
    "Device",
    "Emulator",
    "EmulatorOptions",
    "ModbusEmulator",
    "Places",
    "SerialEmulator",
    "SerialEmulatorOptions",
    "VirtualAdapter",
    "cut_packets",
    "on_a_grid",
    "on_pads",
]
