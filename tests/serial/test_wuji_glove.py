"""The glove driver: vectors of the wire, and the driver on a pseudo terminal."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skinware import PatchState, Status
from skinware.errors import RequestFailed
from skinware_drivers.serial.wuji_glove import WujiGloveDriver
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.virtual import Device
from skinware_drivers.virtual.devices.wuji_glove import EmulatedWujiGlove, EmulatedWujiGloveOptions, message
from tests.sdk.driving import read_until, restarted_on_demand
from tests.serial.spoken import Spoken

DEVICE_INFO = bytes.fromhex("AA 56 0A 00 01 01 01 00 A7 FA")


def test_bytes_of_commands_are_those_of_the_vector() -> None:
    assert WujiGloveDriver.commands is not None
    assert WujiGloveDriver.commands.encode(0, b"\1\1\1\0") == DEVICE_INFO == message(0x56, b"\1\1\1\0")
    assert WujiGloveDriver.framing.framer().feed(DEVICE_INFO) == []


def test_the_emulated_board_byte_for_byte() -> None:
    board = Spoken(EmulatedWujiGlove(EmulatedWujiGloveOptions(pattern="cycle", hand="right", invalid=(767,))))
    info = b"EMULATED-1" + bytes(14) + bytes((1, 0, 0, 0, 1, 2, 3, 0))
    assert board.answers(DEVICE_INFO) == [message(0x57, b"\1\1\1\0\0" + info)]
    assert board.answers(DEVICE_INFO[:-1] + b"\0") == [message(0x57, b"\1\1\1\0\x11")]
    assert board.answers(message(0x56, b"\x99\1\2\0")) == [message(0x57, b"\x99\1\2\0\x12")]
    assert board.answers(message(0x56, b"\1\4\3\0")) == [message(0x57, b"\1\4\3\0\x13")]
    assert board.answers(message(0x56, b"\2\5\4\0\2\0\0\x64\0")) == [message(0x57, b"\2\5\4\0\0")]
    assert board.answers(message(0x56, b"\2\1\6\0")) == [message(0x57, b"\2\1\6\0\0emulated")]
    assert board.answers(message(0x56, b"\1\5\7\0\1\0")) == [message(0x57, b"\1\5\7\0\0\1\0")]
    answer, *frames = board.answers(message(0x56, b"\1\4\5\0\1"), 45)
    assert answer == message(0x57, b"\1\4\5\0\0")
    assert len(frames) in (4, 5)
    for cycle, frame in enumerate(frames):
        assert len(frame) == 3088
        assert frame[:8] == bytes.fromhex("AA 55 10 0C 01 00 00 00")
        cells = np.frombuffer(frame, "<f4", 768, 8)
        assert cells[:767].tolist() == [cycle / 4096] * 767
        assert np.isnan(cells[767])
        assert frame[3080:3082] == cycle.to_bytes(2, "little")
        assert frame == message(0x55, frame[4:-2])


def test_values_invalid_cells_and_operations() -> None:
    with emulated_skin(
        WujiGloveDriver, EmulatedWujiGlove, driver_options={"rate_hz": 50}, pattern="cycle", invalid=(5,), hand="right"
    ) as skin:
        reader = skin.reader
        frame = read_until(reader, lambda f: not (f.status & Status.STALE).any())
        assert frame.structure.patch_name.tolist() == [b"right glove"]
        assert np.flatnonzero(frame.status).tolist() == [5]
        assert frame.status[5] == Status.NOT_CONNECTED
        assert len(set(np.delete(frame.values, 5).tolist())) == 1
        assert reader.call("rate", hz=100) == {"bus0": 100.0}
        with pytest.raises(RequestFailed, match="give 1 to 1000"):
            reader.call("rate", hz=0)
        counts = reader.call("counts")["bus0"]
        assert counts["frames"] > 0
        assert counts["checksum_errors"] == 0
        reader.call("enable", on=False)
        read_until(reader, lambda f: f.patch_state[0] != PatchState.LIVE)
        reader.call("enable")
        read_until(reader, lambda f: f.patch_state[0] == PatchState.LIVE)


@pytest.mark.parametrize("streaming", [True, False])
def test_the_stream_is_left_as_it_was_found(streaming: bool) -> None:
    """The maker's example never switches it on."""
    stopped = []

    class Watched(EmulatedWujiGlove):
        def stop(self, device: Device) -> None:
            stopped.append(device.number)
            super().stop(device)

    with emulated_skin(WujiGloveDriver, Watched, streaming=streaming) as skin:
        read_until(skin.reader, lambda f: f.patch_state[0] == PatchState.LIVE)
    assert stopped == ([] if streaming else [1])


def test_it_is_set_up_again_after_a_restart_and_damage_is_not_shown() -> None:
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "corrupt": 0.02, "repeat": 0.02}
    devices = restarted_on_demand(EmulatedWujiGlove)
    with emulated_skin(WujiGloveDriver, devices, pattern="cycle", boot_s=0.1, **faults) as skin:
        reader = skin.reader
        for live in (True, False, True):
            if not live:
                devices.restart_now = True
            frame = read_until(reader, lambda f, live=live: (f.patch_state[0] == PatchState.LIVE) == live)  # type: ignore[misc]
            assert len(set(frame.values.tolist())) == 1
