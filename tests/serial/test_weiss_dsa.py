"""The DSA driver: vectors of the wire, and the driver on emulated controllers."""

from __future__ import annotations

import asyncio
import struct

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.link import Link
from skinware_drivers.registry import make_bus
from skinware_drivers.serial.framing import Framed
from skinware_drivers.serial.weiss import WeissDsaDriver, WeissDsaOptions, _expanded, _Matrix
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.virtual.devices.weiss import EmulatedWeissDsa, EmulatedWeissDsaOptions
from skinware_drivers.virtual.devices.weiss import dsa_message as message
from tests.sdk.driving import read_until
from tests.serial.spoken import Spoken

START_30_FPS_WITH_RUNS = bytes.fromhex("AA AA AA 03 03 00 81 1E 00 2C 76")
STOP = bytes.fromhex("AA AA AA 03 03 00 01 00 00 2F 6A")  # as the maker's program sends it
MATRICES = bytes.fromhex("AA AA AA 02 00 00")


def test_bytes_of_commands_are_those_of_the_vectors() -> None:
    framing = WeissDsaDriver.framing
    for wire, command, payload in ((START_30_FPS_WITH_RUNS, 0x03, b"\x81\x1e\0"), (MATRICES, 0x02, b"")):
        assert framing.encode(command, payload) == wire == message(command, payload)
    assert framing.framer().feed(MATRICES + START_30_FPS_WITH_RUNS) == [
        Framed(0x02, b"", 6),
        Framed(0x03, b"\x81\x1e\0", 17),
    ]


def test_the_emulated_controller_byte_for_byte() -> None:
    controller = Spoken(EmulatedWeissDsa(EmulatedWeissDsaOptions(fingers=1, pattern="cycle")))
    assert controller.answers(MATRICES) == [message(0x02, bytes.fromhex("0000 0200 0000 01 2A000000 00"))]
    [matrix] = controller.answers(message(0x0B, b"\x01"))
    assert len(matrix) == 8 + 52
    assert struct.unpack_from("<HffHH", matrix, 6) == (0, pytest.approx(3.4), pytest.approx(3.4), 6, 13)
    wrong = bytearray(START_30_FPS_WITH_RUNS)
    wrong[-1] ^= 1
    assert controller.answers(bytes(wrong)) == [message(0x03, b"\1\0")]
    first, frame, *_ = controller.answers(START_30_FPS_WITH_RUNS, 150)
    assert first == message(0x03, b"\0\0")
    cells = np.frombuffer(_expanded(frame[11:-2]), "<u2")
    assert cells.tolist() == [0] * 162
    assert controller.answers(STOP)[-1] == message(0x03, b"\0\0")
    assert controller.answers(b"", 500) == []
    first, frame = controller.answers(message(0x03, b"\x80\0\0"), 500)
    assert first == message(0x03, b"\0\0")
    assert len(frame) == 8 + 5 + 2 * 162


def test_a_controller_is_stopped_as_by_the_makers_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the flag for data, a rate of 0 asks for a single frame."""
    asked = list[bytes]()

    async def ask(_driver: object, _link: Link, command: int, payload: bytes, **_more: object) -> bytes:
        asked.append(WeissDsaDriver.framing.encode(command, payload))
        return b""

    monkeypatch.setattr(WeissDsaDriver, "_ask", ask)
    asyncio.run(WeissDsaDriver(WeissDsaOptions()).stop(Link(make_bus("/dev/null"))))
    assert asked == [STOP]


@pytest.mark.parametrize("options", [{}, {"rle_offset": 5}])
def test_data_of_both_codings_become_matrices(options: dict[str, int]) -> None:
    with emulated_skin(WeissDsaDriver, EmulatedWeissDsa, pattern="cycle", driver_options=options) as skin:
        frame = read_until(skin.reader, lambda f: not f.status.any() and int(f.values[0]) > 1)
        assert len(set(frame.values.tolist())) == 1
        structure = frame.structure
        assert structure.module_kind.tolist() == [b"14x6", b"13x6"] * 3
        assert structure.module_name[:2].tolist() == [b"finger 1 proximal", b"finger 1 distal"]
        assert structure.geometry is not None
        assert structure.geometry.known.all()
        assert skin.reader.call("controller") == {"bus0": {"serial_number": 4711, "hardware": 2, "software": 300}}


def test_run_lengths_that_do_not_make_a_frame_are_not_shown() -> None:
    driver = WeissDsaDriver(WeissDsaOptions(rle_offset=5))
    driver._cells = (_Matrix(2, 1, 3.4, 3.4), _Matrix(1, 1, 3.4, 3.4))
    header = bytes.fromhex("0A000000 01")
    whole = header + struct.pack("<2H", 2 << 12 | 7, 1 << 12 | 0xFFF)
    assert list(driver._split(0, whole)) == [
        (0x100, bytes.fromhex("0A000000 0700 0700")),
        (0x101, bytes.fromhex("0A000000 FF0F")),
    ]
    for wrong in (header, header + b"\x07", header + struct.pack("<H", 2 << 12), header + struct.pack("<H", 4 << 12)):
        assert [identifier for identifier, _ in driver._split(0, wrong)] == [0x200]
    assert list(driver._split(0, b"\0\0")) == [(0, b"\0\0")]
    assert list(driver._split(3, b"\0\0")) == [(3, b"\0\0")]


def test_impossible_options() -> None:
    with pytest.raises(ConfigurationError, match="rle_offset"):
        WeissDsaOptions(rle_offset=7)  # type: ignore[arg-type]
