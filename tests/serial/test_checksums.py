"""Checksums against the check values of the usual catalogues, one by one and many at once."""

from __future__ import annotations

import numpy as np
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


@settings(BUSY, max_examples=80)
@given(checksum=st.sampled_from([checksum for checksum, _ in KNOWN]), data=st.data())
def test_many_at_once_are_as_one_by_one(checksum: Checksum, data: st.DataObject) -> None:
    pieces = data.draw(st.lists(st.one_of(st.binary(max_size=80), st.just(CHECK), st.just(b"")), min_size=1))
    pieces += [
        seed * times for seed, times in data.draw(st.lists(st.tuples(st.binary(max_size=9), st.integers(1, 99))))
    ]
    longest = max(map(len, pieces))
    buffer = np.frombuffer(bytes(longest) + b"".join(pieces) + bytes(4), np.uint8)
    stop = longest + np.cumsum([len(piece) for piece in pieces])
    start = stop - [len(piece) for piece in pieces]
    assert checksum.of_many(buffer, start, stop).tolist() == [checksum.of(piece) for piece in pieces]


@pytest.mark.parametrize("crc", [checksums.CRC16_WEISS, checksums.CRC16_MODBUS, checksums.CRC32C, checksums.CRC8])
def test_long_data_is_as_byte_by_byte(crc: Crc) -> None:
    for size in (64, 65, 127, 128, 129, 257, 1000, 3088):
        data = np.random.default_rng(size).bytes(size)
        assert crc.of(data) == crc._finish(crc._after(data, crc._first_state))


def test_weiss_vectors() -> None:
    """Commands as the devices' public drivers send them, and the residue."""
    assert checksums.CRC16_WEISS.to_bytes(bytes.fromhex("AA AA AA 21 03 00 00 0A 00")).hex() == "dab5"
    assert checksums.CRC16_WEISS.to_bytes(bytes.fromhex("AA AA AA 30 00 00")).hex() == "cacf"
    assert checksums.CRC16_WEISS.to_bytes(bytes.fromhex("03 03 00 81 1E 00")).hex() == "2c76"
    assert checksums.CRC16_WEISS.of(CHECK + checksums.CRC16_WEISS.to_bytes(CHECK)) == 0


def test_order_and_reading() -> None:
    big = checksums.CRC16_XMODEM.with_order("big")
    assert big.to_bytes(CHECK) == b"\x31\xc3"
    buffer = np.frombuffer(b"\x31\xc3\x31\xc3", np.uint8)
    assert big.read_many(buffer, np.array([0, 2])).tolist() == [0x31C3, 0x31C3]
    assert checksums.CRC16_XMODEM.read_many(buffer, np.array([1])).tolist() == [0x31C3]


def test_widths_that_cannot_be_had() -> None:
    with pytest.raises(ConfigurationError, match="8 to 32"):
        Crc(width=64, polynomial=0x1B)
