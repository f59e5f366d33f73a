"""Serial lines: the adapter that drivers of serial devices subclass, framings, and checksums."""

from skinware_drivers.serial.adapter import Answers, Refused, SerialAdapter
from skinware_drivers.serial.checksums import (
    CRC8,
    CRC16_CCITT_FALSE,
    CRC16_MODBUS,
    CRC16_WEISS,
    CRC16_X25,
    CRC16_XMODEM,
    CRC32,
    CRC32C,
    LRC,
    SUM8,
    XOR,
    Crc,
    Sum,
    Xor,
)
from skinware_drivers.serial.delimited import COBS, HDLC, LINES, SLIP, Delimited
from skinware_drivers.serial.framing import Field, Unframed
from skinware_drivers.serial.framings import LengthFirst, Part, Recurring, Split, TextMatrix, by_length
from skinware_drivers.serial.packets import Length, LengthTable, Packet

__all__ = [
    "COBS",
    "CRC8",
    "CRC16_CCITT_FALSE",
    "CRC16_MODBUS",
    "CRC16_WEISS",
    "CRC16_X25",
    "CRC16_XMODEM",
    "CRC32",
    "CRC32C",
    "HDLC",
    "LINES",
    "LRC",
    "SLIP",
    "SUM8",
    "XOR",
    "Answers",
    "Crc",
    "Delimited",
    "Field",
    "Length",
    "LengthFirst",
    "LengthTable",
    "Packet",
    "Part",
    "Recurring",
    "Refused",
    "SerialAdapter",
    "Split",
    "Sum",
    "TextMatrix",
    "Unframed",
    "Xor",
    "by_length",
]
