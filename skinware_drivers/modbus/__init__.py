"""Modbus over serial lines (RTU) and TCP: the adapter that drivers subclass, and the registers that they declare."""

from skinware_drivers.modbus.adapter import ModbusAdapter, ModbusException
from skinware_drivers.modbus.registers import Order, Registers

__all__ = ["ModbusAdapter", "ModbusException", "Order", "Registers"]
