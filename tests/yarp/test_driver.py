"""The driver of a robot's ports, as a user has it: what is shown, and what happens when the robot is not as it was."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.status import BusState, PatchState, Status
from skinware_drivers.streams.yarp import Triangles, YarpOptions
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.commands import running
from tests.sdk.driving import follow
from tests.yarp.peers import LOCAL, PORT, Robot, robot, vector


class Skin:
    """What a port says, again and again; its values can be changed."""

    def __init__(self, values: list[float]) -> None:
        self.values = values
        self.over = threading.Event()

    def __call__(self, caller: socket.socket) -> None:
        while not self.over.wait(0.01):
            caller.sendall(vector(self.values))


@pytest.fixture
def hand() -> Iterator[tuple[Skin, Robot]]:
    skin = Skin([float(value % 256) for value in range(192)])
    with robot(skin) as there:
        yield skin, there
        skin.over.set()


def test_without_files_each_value_is_a_taxel(namespace: object, hand: tuple[Skin, Robot]) -> None:
    skin, there = hand
    with emulated_skin("yarp", bus=there.bus) as driver:
        frame = read_until(driver.reader, lambda f: not f.status.any())
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"values 0-191"]
        assert structure.sensor_uid.tolist() == list(range(192))
        assert [(kind.name, kind.unit) for kind in structure.types] == [("pressure", "counts")]
        assert frame.physical("pressure").tolist() == skin.values
        assert structure.n_modules == 16

        skin.values = [1.0, float("nan"), 3.0] + [9.0] * 189
        frame = read_until(driver.reader, lambda f: f.values[0] == 1)
        assert frame.status.tolist() == [0, Status.SUSPECT] + [0] * 190
        assert frame.values[2] == 3


FILES = YarpOptions(
    values="raw",
    length=192,
    triangles=(
        Triangles(10, 0, (0, 1), "fingertip"),
        Triangles(10, 0, (8,), "palm", (11,)),
        Triangles(3, 144, (0, 3)),
    ),
)


def test_with_files_values_are_what_these_say(namespace: object, hand: tuple[Skin, Robot]) -> None:
    skin, there = hand
    with emulated_skin("yarp", bus=there.bus, driver_options=msgspec.to_builtins(FILES)) as driver:
        frame = read_until(driver.reader, lambda f: not f.status.any())
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"board 10", b"board 3"]
        assert structure.module_name.tolist() == [
            b"fingertip 0",
            b"fingertip 1",
            b"palm 8",
            b"triangle 0",
            b"triangle 3",
        ]
        assert structure.sensor_uid[structure.index("temperature")].tolist() == [107, 150, 154, 186, 190]
        places = structure.sensor_uid[structure.index("pressure")].astype(int)
        assert frame.physical("pressure").tolist() == (255 - np.array(skin.values)[places]).tolist()


def test_compensated_ports_have_no_temperature(namespace: object, hand: tuple[Skin, Robot]) -> None:
    _, there = hand
    options = YarpOptions(length=192, triangles=FILES.triangles)
    with emulated_skin("yarp", bus=there.bus, driver_options=msgspec.to_builtins(options)) as driver:
        frame = read_until(driver.reader, lambda f: not f.status.any())
        assert [kind.name for kind in frame.structure.types] == ["pressure"]
        assert len(frame.values) == 5 * 12 - 5


def test_a_port_with_other_values_is_described_anew(namespace: object, hand: tuple[Skin, Robot]) -> None:
    skin, there = hand
    with emulated_skin("yarp", bus=there.bus) as driver:
        read_until(driver.reader, lambda f: not f.status.any())
        skin.values = [7.0] * 30
        frame = follow(driver.reader, lambda f: len(f.values) == 30 and not f.status.any())
        assert frame.structure.n_modules == 3
        assert (frame.values == 7).all()


def test_a_port_that_does_not_fit_the_files_is_told_of_and_not_shown(
    namespace: object, hand: tuple[Skin, Robot], caplog: pytest.LogCaptureFixture
) -> None:
    skin, there = hand
    with emulated_skin("yarp", bus=there.bus, driver_options=msgspec.to_builtins(FILES)) as driver:
        read_until(driver.reader, lambda f: not f.status.any())
        skin.values = [7.0] * 30
        wait_until(lambda: "messages have 30 values, and not 192" in caplog.text)
        read_until(driver.reader, lambda f: f.patch_state.tolist() == [PatchState.STALE] * 2)
        skin.values = [8.0] * 192
        read_until(driver.reader, lambda f: not f.status.any() and (f.values == 8).all())


def test_port_and_name_server_go_and_come_back(namespace: object, hand: tuple[Skin, Robot]) -> None:
    _, there = hand
    with emulated_skin("yarp", bus=there.bus) as driver:
        read_until(driver.reader, lambda f: not f.status.any())
        asked = len(there.asked)
        there.restart_port()
        wait_until(lambda: len(there.asked) > asked)
        read_until(driver.reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())
        there.server.close()
        there.restart_port()
        read_until(driver.reader, lambda f: f.bus_state[0] in (BusState.GONE, BusState.DOWN, BusState.CONNECTING))
        there.restart_server()
        read_until(driver.reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())


@pytest.mark.thorough
def test_the_emulated_robot_is_one(namespace: object) -> None:
    with running("skin-emulate", "--driver", "yarp", "--bus", f"yarp://{LOCAL}:0{PORT}") as there:
        where = there.wait_for("ready")["note"].removeprefix("listens on ")
        with emulated_skin("yarp", bus=f"yarp://{where}{PORT}") as driver:
            read_until(driver.reader, lambda f: not f.status.any())
            assert driver.driver.status()["buses"][0]["bad_form"] == 0


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"triangles": (Triangles(7, 0, (0,)),)}, "give length"),
        ({"length": 24, "triangles": (Triangles(7, 0, (2,)),)}, "outside"),
        ({"length": 24, "triangles": (Triangles(7, -12, (0,)),)}, "outside"),
        ({"length": 48, "triangles": (Triangles(7, 0, (0, 1)), Triangles(8, 6, (0,)))}, "where another one is"),
        ({"length": 3072, "triangles": tuple(Triangles(b, 12 * b, (0,)) for b in range(17))}, "more than 16 boards"),
        ({"length": 4000}, "length"),
        ({"period_ms": 0}, "period_ms"),
    ],
)
def test_impossible_options(options: dict[str, object], why: str) -> None:
    with pytest.raises(ConfigurationError, match=why):
        YarpOptions(**options)  # type: ignore[arg-type]
