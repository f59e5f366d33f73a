"""Checksums against the check values of the usual catalogues, and CRCs against their definition."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware.errors import ConfigurationError
from skinware_drivers.serial import checksums
from skinware_drivers.serial.checksums import Checksum, Crc, Sum, Xor
from tests.serial.streams import BUSY

CHECK = b"123456789"
KNOWN: list[tuple[Checksum, int]] = [
    (checksums.CRC8, 0xF4),
    (checksums.CRC16_XMODEM, 0x31C3),
    (checksums.CRC16_CCITT_FALSE, 0x29B1),
    (checksums.CRC16_MODBUS, 0x4B37),
    (checksums.CRC16_X25, 0x906E),
    (checksums.CRC32, 0xCBF43926),
    (checksums.CRC32C, 0xE3069283),
    (checksums.CRC16_WEISS, 0x6EB4),
    (Crc(width=12, polynomial=0x80F, reflected_out=True), 0xDAF),  # CRC-12/UMTS
    (Crc(width=24, polynomial=0x864CFB, init=0xB704CE), 0x21CF02),  # CRC-24/OPENPGP
    (Crc(width=16, polynomial=0x1021, init=0x89EC, reflected_in=True, reflected_out=True), 0x26B1),  # TMS37157
    (Crc(width=8, polynomial=0x31, reflected_in=True, reflected_out=True), 0xA1),  # CRC-8/MAXIM-DOW
    (checksums.SUM8, sum(CHECK) & 0xFF),
    (checksums.LRC, -sum(CHECK) & 0xFF),
    (Sum(width=16), sum(CHECK)),
    (checksums.XOR, 0x31),
    (Xor(init=0xFF), 0xCE),
]


def test_check_values() -> None:
    for checksum, value in KNOWN:
        assert checksum.of(CHECK) == value, checksum
        assert checksum.to_bytes(CHECK) == value.to_bytes(checksum.size, "little")


def bit_by_bit(crc: Crc, data: bytes) -> int:
    """A CRC by its definition: one bit of the message after the other through the register."""
    register = crc.init
    for byte in data:
        for bit in range(8) if crc.reflected_in else range(7, -1, -1):
            out = register >> (crc.width - 1) & 1 ^ byte >> bit & 1
            register = (register << 1 & (1 << crc.width) - 1) ^ (crc.polynomial if out else 0)
    if crc.reflected_out:
        register = int(f"{register:0{crc.width}b}"[::-1], 2)
    return register ^ crc.xor_out


@settings(BUSY, max_examples=60)
@given(
    crc=st.sampled_from([crc for crc, _ in KNOWN if isinstance(crc, Crc) and not crc.plain_table]),
    data=st.binary(max_size=300),
)
def test_a_crc_is_as_bit_by_bit(crc: Crc, data: bytes) -> None:
    assert crc.of(data) == bit_by_bit(crc, data)


def test_weiss_vectors() -> None:
    """Commands as the devices' public drivers send them, and the residue."""
    assert checksums.CRC16_WEISS.to_bytes(bytes.fromhex("AA AA AA 21 03 00 00 0A 00")).hex() == "dab5"
    assert checksums.CRC16_WEISS.to_bytes(bytes.fromhex("AA AA AA 30 00 00")).hex() == "cacf"
    assert checksums.CRC16_WEISS.to_bytes(bytes.fromhex("03 03 00 81 1E 00")).hex() == "2c76"
    assert checksums.CRC16_WEISS.of(CHECK + checksums.CRC16_WEISS.to_bytes(CHECK)) == 0


def test_order() -> None:
    assert replace(checksums.CRC16_XMODEM, order="big").to_bytes(CHECK) == b"\x31\xc3"


def test_widths_that_cannot_be_had() -> None:
    with pytest.raises(ConfigurationError, match="8 to 32"):
        Crc(width=64, polynomial=0x1B)
