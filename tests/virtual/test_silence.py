"""The option ``silence``: each kind of frame can be silent alone, on every emulator."""

from __future__ import annotations

from typing import Any

import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.loading import registered
from skinware_drivers.virtual import Emulator, ModbusEmulator
from skinware_drivers.virtual.hardware import EMULATORS, load_emulator
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin

_SECOND_NS = 1_000_000_000


def _powered_up(name: str, **options: object) -> Emulator[Any] | EmulatedRoboskin:
    emulator = load_emulator(name)
    devices = emulator(emulator.Options(streaming=True, **options))
    assert isinstance(devices, Emulator | EmulatedRoboskin)
    devices.skip(_SECOND_NS)
    return devices


def _kinds_sent(devices: Emulator[Any] | EmulatedRoboskin, until_ns: int) -> set[str]:
    return {devices.kind_of(frame.identifier, frame.payload) for frame in devices.emit(until_ns)}


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(registered(EMULATORS)))
def test_a_kind_falls_silent_at_its_time_and_no_other_does(name: str) -> None:
    usual = _powered_up(name)
    usual.emit(2 * _SECOND_NS)
    sent = sorted(_kinds_sent(usual, 3 * _SECOND_NS) & set(usual.kinds()))
    for kind in {*sent[:1], *sent[-1:]}:  # devices that only answer are asked in the tests of their drivers
        devices = _powered_up(name, silence=(kind,), silence_after_s=1)
        assert kind in _kinds_sent(devices, 2 * _SECOND_NS - 1)
        devices.emit(2 * _SECOND_NS)
        assert _kinds_sent(devices, 3 * _SECOND_NS) & set(sent) == set(sent) - {kind}
        assert devices.counts["silenced"]


@pytest.mark.parametrize("name", sorted(registered(EMULATORS)))
def test_an_unknown_kind_is_refused_with_those_that_exist(name: str) -> None:
    first = next(iter(_powered_up(name).kinds()))
    with pytest.raises(ConfigurationError, match=f"'nonsense' is no kind of frame; there are {first}"):
        _powered_up(name, silence=("nonsense",))


def test_a_silent_register_leaves_its_question_without_answer_and_others_answered() -> None:
    devices = _powered_up("revo2", silence=("4210",), silence_after_s=0)
    assert isinstance(devices, ModbusEmulator)
    devices.receive(0, _with_checksum(bytes.fromhex("7f041068001e")), 2 * _SECOND_NS)
    assert devices.emit(3 * _SECOND_NS) == []
    devices.receive(0, _with_checksum(bytes.fromhex("7f0410680004")), 3 * _SECOND_NS)
    assert [frame.payload[:3].hex() for frame in devices.emit(4 * _SECOND_NS)] == ["7f0408"]


def test_silent_halves_are_left_out_of_datagrams() -> None:
    devices = _powered_up("icub_eth", silence=("0x411-tail",), silence_after_s=0, boards=(1,), triangles=2)
    datagrams = [frame.payload for frame in devices.emit(2 * _SECOND_NS)]
    assert datagrams
    assert all(datagram.count(b"\x11\x84") == 1 for datagram in datagrams)


def _with_checksum(data: bytes) -> bytes:
    remainder = 0xFFFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder >> 1 ^ (0xA001 if remainder & 1 else 0)
    return data + remainder.to_bytes(2, "little")
