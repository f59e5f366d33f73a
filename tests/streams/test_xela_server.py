"""XELA's server: literal messages, and the driver with a real websocket server."""

from __future__ import annotations

import json
import struct
import threading
from typing import Any

import pytest
from websockets.sync.server import ServerConnection

from skinware.errors import ConfigurationError
from skinware.status import PatchState
from skinware_drivers.serial.framing import Framed
from skinware_drivers.streams.xela_server import XelaMessages, XelaServerOptions
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.commands import running
from tests.sdk.driving import follow
from tests.streams.peers import LOCAL
from tests.streams.webservers import web_server

WELCOME = b'{"message": "Welcome"}\n'
COUNTS = (
    b'{"message": 5548, "time": 1695696620.5, "sensors": 1, "type": "routine", "1": {"sensor": "1", "model": "uSPa21",'
    b' "taxels": 2, "time": 1695696620.25, "data": "C0B3,4465,91F5,7F38,7B6C,8C3D"}}\n'
)
FORCES = COUNTS.replace(b'"data"', b'"calibrated": [-0.5, 0.25, 5.5, 0, 0.0, 1e-3], "data"')


def found(stream: bytes) -> list[Framed]:
    return XelaMessages().framer().feed(stream)


def test_counts_are_hexadecimal_and_forces_newtons() -> None:
    structure, counts = found(WELCOME + COUNTS)
    end = len(WELCOME + COUNTS)
    assert structure == Framed(0, b'{"1":["uSPa21",2,false]}', end)
    assert counts[0::2] == (0x401, end)
    ms, *values = struct.unpack("<I6f", counts.body)
    assert ms == 1695696620250 % 2**32
    assert values == [0xC0B3, 0x4465, 0x91F5, 0x7F38, 0x7B6C, 0x8C3D]
    structure, forces = found(FORCES)
    assert (structure.body, forces.identifier) == (b'{"1":["uSPa21",2,true]}', 1)
    assert struct.unpack("<4x6f", forces.body) == pytest.approx((-0.5, 0.25, 5.5, 0, 0, 1e-3))


def test_what_sensors_there_are_is_told_once_and_when_it_changes() -> None:
    framer = XelaMessages().framer()
    stream = (COUNTS, COUNTS, FORCES, FORCES.replace(b'"1": {', b'"2": {'), COUNTS)
    told = [[frame.identifier for frame in framer.feed(message)] for message in stream]
    assert told == [[0, 0x401], [0x401], [0, 1], [0, 2], [0, 0x401]]


def test_it_is_told_now_and_then_all_the_same() -> None:
    told = [frame.identifier for frame in found(COUNTS * 600)]
    assert (told[0], told.count(0x401)) == (0, 600)
    assert told.count(0) == 3


def test_a_list_of_counts_serves_too() -> None:
    plain = COUNTS.replace(b'"data": "C0B3,4465,91F5,7F38,7B6C,8C3D"', b'"integer": [1, 2, 3, 65535, 0, 6]')
    assert struct.unpack("<4x6f", found(plain)[1].body) == (1, 2, 3, 65535, 0, 6)


@pytest.mark.parametrize(
    "wrong",
    [
        b"{",
        b"[]",
        b"7",
        b"null",
        b"\xff\xfe",
        COUNTS.replace(b"message", b"m\xff"),
        b'{"other": 1}',
        b'{"1": []}',
        b"[" * 5000,
        COUNTS.replace(b'"taxels": 2', b'"taxels": 3'),
        COUNTS.replace(b'"taxels": 2', b'"taxels": true'),
        COUNTS.replace(b'"taxels": 2', b'"taxels": 1e9'),
        COUNTS.replace(b"C0B3", b"1C0B3"),
        COUNTS.replace(b"C0B3", b"-1"),
        COUNTS.replace(b"C0B3", b"what"),
        COUNTS.replace(b'"1": {', b'"0": {'),
        COUNTS.replace(b'"1": {', b'"256": {'),
        COUNTS.replace(b'"1": {', b'"01": {'),
        COUNTS.replace(b"1695696620.25", b'"now"'),
        COUNTS.replace(b'"uSPa21"', b"21"),
        FORCES.replace(b"-0.5", b'"-0.5"'),
        FORCES.replace(b"-0.5", b"1e300"),
        FORCES.replace(b"-0.5, ", b""),
        json.dumps({str(number): {} for number in range(1, 200)}).encode(),
    ],
)
def test_messages_that_make_no_sense_are_counted_and_never_raised(wrong: bytes) -> None:
    framer = XelaMessages().framer()
    line = wrong.rstrip(b"\n") + b"\n"
    frames = framer.feed(line + COUNTS)
    assert [frame.identifier for frame in frames] == [0, 0x401]
    assert (framer.counters.refused, framer.counters.skipped_bytes) == (1, len(line))
    assert framer.counters.bytes_in == len(line + COUNTS)


def message(number: int, **sensors: dict[str, Any]) -> str:
    told = {name.removeprefix("s"): {"sensor": name.removeprefix("s"), **sensor} for name, sensor in sensors.items()}
    return json.dumps({"message": number, "time": 1e9 + number / 100, "type": "routine", **told})


def sensor(model: str, taxels: int, first: float, *, forces: bool) -> dict[str, Any]:
    values = [first + axis for axis in range(3 * taxels)]
    told = {"model": model, "taxels": taxels, "data": ",".join(f"{round(value) & 0xFFFF:X}" for value in values)}
    return told | ({"calibrated": values} if forces else {})


class Suite:
    """A server whose sensors can change."""

    def __init__(self) -> None:
        self.sensors = {
            "s1": sensor("uSPa44", 16, 0.0, forces=True),
            "s2": sensor("uSPa46", 24, 100, forces=False),
            "s3": sensor("uSCuAH", 30, 200, forces=False),
        }
        self.over = threading.Event()

    def __call__(self, connection: ServerConnection) -> None:
        connection.send('{"message": "Welcome"}')
        number = 0
        while not self.over.wait(0.01):
            number += 1
            try:
                connection.send(message(number, **self.sensors))
            except Exception:  # noqa: BLE001 - the caller has gone
                return


def test_several_sensors_of_one_server_each_as_it_is(namespace: object) -> None:
    suite = Suite()
    with web_server(suite) as there:
        with emulated_skin("xela_server", bus=there.bus, driver_options={"grids": ("3=5x6",)}) as skin:
            frame = read_until(skin.reader, lambda f: (f.patch_state == PatchState.LIVE).all() and not f.status.any())
            structure = frame.structure
            assert structure.patch_name.tolist() == [b"sensor 1 uSPa44", b"sensor 2 uSPa46", b"sensor 3 uSCuAH"]
            assert structure.module_kind.tolist() == [b"4x4", b"4x6", b"5x6"]
            assert [(kind.name, kind.unit) for kind in structure.types] == [
                ("shear_x", "counts"),
                ("shear_y", "counts"),
                ("pressure", "counts"),
                ("force_x", "N"),
                ("force_y", "N"),
                ("force_z", "N"),
            ]
            assert frame.values[:48].tolist() == list(range(48))
            assert frame.values[48:120].tolist() == list(range(100, 172))
            assert structure.sensor_uid[:4].tolist() == [1 << 16] * 3 + [1 << 16 | 1]
            assert structure.geometry is not None
            assert structure.geometry.known.all()

            suite.sensors = {"s1": suite.sensors["s1"]}  # the others are not there any more
            read_until(skin.reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE] + [PatchState.STALE] * 2)
        suite.over.set()


def test_a_sensor_that_changes_is_described_anew(namespace: object) -> None:
    suite = Suite()
    with web_server(suite) as there:
        with emulated_skin("xela_server", bus=there.bus) as skin:
            read_until(skin.reader, lambda f: not f.status.any())
            suite.sensors = {**suite.sensors, "s7": sensor("uSPa22", 4, 7, forces=True)}
            frame = follow(skin.reader, lambda f: f.structure.n_patches == 4 and not f.status.any())
            assert frame.structure.patch_name[-1] == b"sensor 7 uSPa22"
        suite.over.set()


def test_two_drivers_of_one_server(namespace: object) -> None:
    suite, patient = Suite(), {"period_ms": 1000}  # of a busy machine
    with web_server(suite) as there:
        with emulated_skin("xela_server", bus=there.bus, name="one", driver_options=patient) as one:
            with emulated_skin("xela_server", bus=there.bus, name="two", driver_options=patient) as two:
                for skin in (one, two):
                    newest = int(read_until(skin.reader, lambda f: not f.status.any()).module_time_ns.max())
                    read_until(skin.reader, lambda f, then=newest: bool((f.module_time_ns > then).all()))  # type: ignore[misc]
        suite.over.set()


def send_some(connection: ServerConnection) -> None:
    """Messages for a second, about."""
    over = threading.Event()
    for number in range(100):
        connection.send(message(number, s1=sensor("uSPa44", 16, number, forces=True)))
        over.wait(0.01)


def test_a_server_that_comes_and_goes_is_called_again(namespace: object, caplog: pytest.LogCaptureFixture) -> None:
    def handle(connection: ServerConnection) -> None:
        send_some(connection)
        connection.close(1012, "restart")

    with web_server(handle) as there:
        with emulated_skin("xela_server", bus=there.bus, driver_options={"learn_s": 0.05}):
            wait_until(lambda: there.callers >= 2)
            assert "the server has closed the connection: 1012" in caplog.text


def test_a_server_that_hangs_is_called_again(namespace: object) -> None:
    def handle(connection: ServerConnection) -> None:
        send_some(connection)
        for _ in connection:  # and no word more
            pass

    with web_server(handle) as there:
        with emulated_skin("xela_server", bus=f"{there.bus}?silence_s=0.3", driver_options={"learn_s": 0.05}):
            wait_until(lambda: there.callers >= 2)


def test_impossible_options() -> None:
    with pytest.raises(ConfigurationError, match="NUMBER=ROWSxCOLUMNS"):
        XelaServerOptions(grids=("4x4",))
    options = XelaServerOptions(grids=("2=3x5",))
    assert options.grid(1, "uSPa44", 16) is not None
    assert options.grid(1, "uSPa44", 12) is None
    assert options.grid(1, "uSPrDS", 15) is None
    assert (grid := options.grid(2, "uSPrDS", 15)) is not None
    assert (grid.rows, grid.columns) == (3, 5)


@pytest.mark.thorough
def test_the_emulated_server_is_one(namespace: object) -> None:
    with running("skin-emulate", "--driver", "xela_server", "--bus", f"websocket:ws://{LOCAL}:0") as server:
        where = server.wait_for("ready")["note"].removeprefix("listens on ")
        with emulated_skin("xela_server", bus=f"websocket:ws://{where}") as skin:
            read_until(skin.reader, lambda f: not f.status.any())
            assert skin.driver.status()["buses"][0]["bad_form"] == 0
