"""The driver of the AGNI protocol: vectors of the wire, and the driver on a pseudo terminal."""

from __future__ import annotations

import asyncio
import re
import struct
from collections.abc import Sequence
from typing import Any

import pytest

from skinware import PatchState, Status
from skinware.errors import RequestFailed
from skinware_drivers.link import Link
from skinware_drivers.registry import make_bus
from skinware_drivers.serial.agni import AgniDriver, AgniOptions, command
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.vectors import Shown, decode_stream
from skinware_drivers.virtual import Device
from skinware_drivers.virtual.devices.agni import EmulatedAgni, EmulatedAgniOptions, message
from tests.sdk.driving import read_until, restarted_on_demand
from tests.serial.spoken import Spoken

CONFIGURATION = bytes.fromhex("F0 C4 00 C0 F4")
STOP = bytes.fromhex("F0 C4 00 00 34")
START = bytes.fromhex("F0 C4 00 F1 C5")


def test_bytes_of_commands_are_those_of_the_vectors() -> None:
    assert (command(0xC0), command(0x00), command(0xF1)) == (CONFIGURATION, STOP, START)
    period = command(0xD0, bytes.fromhex("0200 01 0A00 02 0A00"))
    assert period == message(0, bytes.fromhex("D0 0200 01 0A00 02 0A00"))


def test_a_period_is_sent_in_tenths_of_a_millisecond(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, sent = AgniDriver(AgniOptions(period_ms=20)), list[bytes]()

    async def send(_link: object, _identifier: int, payload: bytes) -> None:
        sent.append(payload)

    monkeypatch.setattr(Link, "send", send)
    driver._n_sensors = 2
    asyncio.run(driver.configure(Link(make_bus("/dev/null"))))
    assert sent == [command(0xD0, bytes.fromhex("0200 01 C800 02 C800"))]


def test_the_emulated_device_byte_for_byte() -> None:
    device = Spoken(EmulatedAgni(EmulatedAgniOptions(sensors=(1, 2), pattern="cycle")))
    assert device.answers(b"noise" + CONFIGURATION) == [message(0, bytes.fromhex("01 07 02 0302 0200 0302 0400"))]
    assert device.answers(CONFIGURATION[:-1] + b"\0") == [bytes.fromhex("F0 C4 FE F0 3A")]
    assert device.answers(command(0x99)) == [bytes.fromhex("F0 C4 FE F1 3B")]
    assert device.answers(command(0xF0)) == [bytes.fromhex("F0 C4 F0 C4")]
    assert device.answers(command(0xD0, bytes.fromhex("0200 01 C800 02 C800"))) == []
    assert (
        device.answers(bytes.fromhex("F0 C4 01 D0 02 00 F4 01 12")) == []
    )  # of one sensor, as the maker's host sends it
    assert device.answers(bytes.fromhex("F0 C4 01 D0 02 00 C8 00 2F")) == []
    assert device.answers(bytes.fromhex("F0 C4 03 D0 02 00 C8 00 2D")) == [bytes.fromhex("F0 C4 FE F2 38")]
    frames = device.answers(START, 65)
    assert len(frames) in (6, 8)
    for at, frame in enumerate(frames):
        assert frame == message(at % 2 + 1, frame[3:7] + (at // 2).to_bytes(2, "little") * (at % 2 + 1))
    assert device.answers(STOP, 100) == []


def test_a_device_that_streams_already_and_describes_itself() -> None:
    emulated: dict[str, Any] = {"pattern": "cycle", "streaming": True, "sensors": (5, 300)}
    with emulated_skin(
        AgniDriver, EmulatedAgni, driver_options={"time_unit_us": 1.0, "period_ms": 20}, **emulated
    ) as skin:
        reader = skin.reader
        frame = read_until(reader, lambda f: not f.status.any())
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"device 7"]
        assert structure.module_kind.tolist() == [b"type 515"] * 2
        assert structure.sensor_module.tolist() == [0] * 5 + [1] * 300
        frame = read_until(reader, lambda f: len(set(f.values.tolist())) == 1)
        assert frame.module_time_ns[0] == frame.module_time_ns[1]
        with pytest.raises(RequestFailed, match="give 1 to 6553"):
            reader.call("period", ms=0)
        reader.call("period", ms=10)
        read_until(reader, lambda f: int(f.values[0]) > int(frame.values[0]) + 3)


def test_it_is_set_up_again_after_a_restart_and_damage_is_not_shown() -> None:
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "corrupt": 0.02, "repeat": 0.02}
    devices = restarted_on_demand(EmulatedAgni)
    with emulated_skin(AgniDriver, devices, pattern="cycle", boot_s=0.1, **faults) as skin:
        reader = skin.reader
        for live in (True, False, True):
            if not live:
                devices.restart_now = True
            frame = read_until(reader, lambda f, live=live: (f.patch_state[0] == PatchState.LIVE) == live)  # type: ignore[misc]
            for module in (0, 1):
                assert len(set(frame.values[frame.structure.module_index(module)].tolist())) == 1


# -- the sensors that the makers' library knows by name

SOURCE: dict[str, tuple[str, list[float]]] = {
    "MID_tactile_fingertip_teensy": ("0100 FFFF", [1, 65535]),
    "BMP388modified_pressure_array": ("0100 FFFF", [1, -1]),
    "tactile_glove_teensy": ("01 FF0F 00 01A0", [4094, 0]),
    "tactile_glove_teensy_bend": ("00 0000 01 FF1F", [4095, 0]),
    "Generic_position_sensors_float": ("0000803F 000000C0", [1, -2]),
    "BNO055": ("0100 0200 0300 0400 0500 0600 0700 0800 0900 0A00 0B00 0C00 FFFF", [*range(1, 13), -1]),
    "BMA255": ("0100 0080 FF7F", [1, -32768, 32767]),
    "mpl115a2": ("0000803F", [1]),
    "AS5013": ("7F80", [127, -128]),
    "AS5013_y_position": ("FF", [-1]),
}
"""Bytes, and what the library takes them for: by hand, after ``registered_sensors_impl.h``."""


def decoded(name: str, payloads: Sequence[bytes]) -> Shown:
    """Return the values that the driver shows of a device with one sensor that sends these payloads."""
    driver = AgniDriver(AgniOptions(devices=(name,)))  # type: ignore[arg-type]

    class Described(EmulatedAgni):
        def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
            if command == CONFIGURATION:
                return message(0, bytes((1, 7, 1)) + struct.pack("<HH", 9, len(payloads[0])))
            return b""

    stream = b"".join(message(1, bytes(4) + payload) for payload in payloads)
    decode_stream(driver, b"", strict=False, devices=Described(EmulatedAgniOptions()))  # then it knows the framing
    return decode_stream(driver, stream, strict=False, devices=Described(EmulatedAgniOptions()))


@pytest.mark.parametrize("name", SOURCE)
def test_values_as_the_makers_library_reads_them(name: str) -> None:
    sent, values = SOURCE[name]
    shown = decoded(name, [bytes.fromhex(sent)])
    assert shown.values.tolist() == values
    assert not shown.status.any()


def test_taxels_of_myrmex_lie_where_the_makers_library_has_them() -> None:
    words = [index % 16 << 12 | index for index in range(256)]
    shown = decoded("tactile_module_16x16_v2", [struct.pack("<256H", *words)]).values.reshape(16, 16)
    assert shown[0].tolist() == [208, 224, 32, 0, 209, 225, 33, 1, 210, 226, 34, 2, 211, 227, 35, 3]
    assert shown[:, 0].tolist() == [208, 192, 176, 160, 212, 196, 180, 164, 216, 200, 184, 168, 220, 204, 188, 172]
    assert sorted(shown.ravel().tolist()) == list(range(256))


def test_iobject_has_a_channel_in_each_message() -> None:
    def words(channel: int) -> bytes:
        return struct.pack("<60H", *(channel << 12 | 100 * channel + n for n in range(60)))

    mixed = bytearray(words(3))
    mixed[-1] ^= 0x10
    shown = decoded("iobject_myrmex", [*map(words, range(15)), bytes(mixed)])
    taxels = shown.values.reshape(60, 16)
    assert taxels[:30, 5].tolist() == list(range(500, 560, 2))
    assert taxels[30:, 5].tolist() == list(range(501, 560, 2))
    assert ((shown.status & Status.NEVER_SEEN) != 0).reshape(60, 16).any(0).tolist() == [False] * 15 + [True]


def test_no_measurement_of_an_inertial_sensor() -> None:
    shown = decoded("BNO055", [b"\xa5" * 26])
    assert (shown.status == Status.SUSPECT).all()
    assert shown.structure.module_name.tolist() == [b"BNO055"]


@pytest.mark.parametrize(
    ("name", "length", "message"),
    [
        ("undefined", 3, "no whole number of values '<u2'"),
        ("tactile_glove_teensy", 4, "tactile_glove_teensy sends 3 for each value"),
        ("BNO055", 24, "BNO055 sends 26"),
        ("tactile_module_16x16_v2", 256, "tactile_module_16x16_v2 sends 512"),
    ],
)
def test_a_sensor_that_is_another(name: str, length: int, message: str) -> None:
    with pytest.raises(pytest.fail.Exception, match=f"sensor 1 of type 9 has {length} bytes: {re.escape(message)}"):
        decoded(name, [bytes(length)])


def test_an_emulated_device_with_several_of_them() -> None:
    names = ("tactile_module_16x16_v2", "iobject_myrmex", "tactile_glove_teensy", "BNO055", "AS5013", "mpl115a2")
    emulated: dict[str, Any] = {"pattern": "cycle", "devices": names, "sensors": (1, 1, 20, 1, 1, 1)}
    with emulated_skin(AgniDriver, EmulatedAgni, driver_options={"devices": names}, **emulated) as skin:
        frame = read_until(skin.reader, lambda f: not (f.status & ~Status.SUSPECT).any() and f.values[0] > 16)
        assert frame.structure.n_sensors == 256 + 960 + 20 + 13 + 2 + 1
        for module in (0, 2, 3, 4, 5):
            assert len(set(frame.values[frame.structure.module_index(module)].tolist())) == 1
        assert len(set(frame.values[frame.structure.module_index(1)].tolist())) == 16
