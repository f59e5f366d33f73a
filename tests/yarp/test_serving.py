"""Drivers as ports of YARP: known to the name server, read by our own driver, and nobody's burden."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverWriter
from skinware.errors import ConfigurationError
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns
from skinware.tactile.regions import Region
from skinware.yarp.names import NameServer
from skinware.yarp.port import Receiver
from skinware.yarp.serving import Settings, YarpServer
from skinware_drivers.description import assemble
from skinware_drivers.streams.yarp import YarpDriver, YarpOptions
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.commands import refused, running
from tests.yarp.peers import LOCAL, PATIENCE_S, Robot, robot, until_gone


@pytest.fixture
def yarp() -> Iterator[Robot]:
    with robot(until_gone) as there:
        yield there


class Skin:
    """A driver of ``length`` values that publishes again and again; its values can be changed."""

    def __init__(self, name: str, length: int = 24, *, port: str = "") -> None:
        driver = YarpDriver(YarpOptions())
        patches, _ = driver._of_places(length)
        structure = assemble([(f"yarp://h/icub/{port or name}", patches)], driver.types, np.float32).structure
        self.values = np.arange(length, dtype=np.float32)
        self._writer = DriverWriter(name, structure, driver_type="yarp")
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join(PATIENCE_S)
        self._writer.close()

    def _publish(self) -> None:
        while not self._over.wait(0.01):
            columns = self._writer.begin()
            columns["values"][:] = self.values
            columns["status"][:] = 0
            self._writer.commit(now_ns())


@contextmanager
def served(there: Robot, /, **settings: Any) -> Iterator[tuple[YarpServer, list[dict[str, Any]]]]:
    told: list[dict[str, Any]] = []
    one = YarpServer(Namespace(None), Settings(**settings), NameServer(LOCAL, there.server.port), told.append)
    thread = threading.Thread(target=one.run)
    thread.start()
    try:
        yield one, told
    finally:
        one.stop()
        thread.join(PATIENCE_S)
        one.close()


@pytest.mark.parametrize("version", [3, 4])
def test_what_is_served_is_read_as_it_was(namespace: object, yarp: Robot, version: int) -> None:
    with contextlib.closing(Skin("hand")) as skin, served(yarp, yarp=version) as (there, told):
        wait_until(lambda: "/skinware/hand" in yarp.ports)
        assert told == [{"event": "port", "port": "/skinware/hand", "driver": "hand"}]
        carriers = [f"set /skinware/hand {key} text text_ack tcp fast_tcp".encode() for key in ("offers", "accepts")]
        wait_until(lambda: set(carriers) <= set(yarp.asked))
        with emulated_skin("yarp", name="again", bus=f"yarp://{LOCAL}:{yarp.server.port}/skinware/hand") as driver:
            frame = read_until(driver.reader, lambda f: not f.status.any())
            assert frame.values.tolist() == skin.values.tolist()
            skin.values = skin.values[::-1].copy()
            read_until(driver.reader, lambda f: f.values.tolist() == skin.values.tolist())
            (port,) = [port for name, port in there.ports().items() if name == "/skinware/hand"]
            assert port["registered"]
            assert port["values"] == 24
            assert [(r["name"], r["carrier"]) for r in port["readers"]] == [("skinware", "fast_tcp")]
    assert "/skinware/hand" not in yarp.ports


def test_drivers_come_and_go_and_ports_stay(namespace: object, yarp: Robot) -> None:
    with served(yarp, names=("hand", "foot"), prefix="/icub/skin") as (there, _):
        for length in (24, 36):
            with contextlib.closing(Skin("hand", length)), contextlib.closing(Skin("other")):
                wait_until(lambda length=length: there.ports().get("/icub/skin/hand", {}).get("driver") == "hand")  # type: ignore[misc]
        with contextlib.closing(Skin("foot")):
            wait_until(lambda: {"/icub/skin/hand", "/icub/skin/foot"} <= set(yarp.ports))
        assert set(there.ports()) == {"/icub/skin/hand", "/icub/skin/foot"}
    assert not {name for name in yarp.ports if name.startswith("/icub/skin/hand")} - {"/icub/skin/left_hand_comp"}


def test_a_name_server_that_comes_late_or_forgets_is_told_again(
    namespace: object, yarp: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skinware.yarp.serving._LOOK_S", 0.05)
    yarp.server.close()
    with contextlib.closing(Skin("hand")), served(yarp) as (there, told):
        wait_until(lambda: any(event["event"] == "trouble" for event in told))
        assert not there.ports()["/skinware/hand"]["registered"]
        yarp.restart_server()
        wait_until(lambda: "/skinware/hand" in yarp.ports)
        wait_until(lambda: there.ports()["/skinware/hand"]["registered"])
        del yarp.ports["/skinware/hand"]
        wait_until(lambda: "/skinware/hand" in yarp.ports)


def test_a_name_that_another_program_takes_is_left_to_it(
    namespace: object, yarp: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skinware.yarp.serving._LOOK_S", 0.05)
    with contextlib.closing(Skin("hand")), served(yarp) as (there, told):
        wait_until(lambda: there.ports().get("/skinware/hand", {}).get("registered", False))
        yarp.ports["/skinware/hand"] = ("10.0.0.9", 10099, "tcp")
        wait_until(lambda: any("another program" in event.get("why", "") for event in told))
    assert yarp.ports["/skinware/hand"] == ("10.0.0.9", 10099, "tcp")


def test_a_part_whose_name_no_port_can_have_gets_another(namespace: object, yarp: Robot) -> None:
    parts = (Region("the left/hand", "pressure", patch=("values 0-23",)),)
    with contextlib.closing(Skin("hand")), served(yarp, regions=parts):
        wait_until(lambda: "/skinware/the_left_hand" in yarp.ports)


def test_two_drivers_of_ports_of_one_name_are_never_mixed(namespace: object, yarp: Robot) -> None:
    with contextlib.closing(Skin("hand")), served(yarp) as (there, told):
        wait_until(lambda: bool(there.ports()))
        with contextlib.closing(Skin("other", port="hand", length=30)):
            wait_until(lambda: any("driver hand has the port" in event.get("why", "") for event in told))
            assert {name: port["driver"] for name, port in there.ports().items()} == {"/skinware/hand": "hand"}


def test_ports_may_be_asked_while_others_come(namespace: object, yarp: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    with contextlib.closing(Skin("hand")), served(yarp) as (there, _):
        wait_until(lambda: bool(there.ports()))
        ports = there._ports
        (port,) = ports.values()

        class Growing(list[Receiver]):
            def __iter__(self) -> Iterator[Receiver]:
                """Add another port while this thread asks, as that of the server may."""
                if threading.current_thread() is threading.main_thread():
                    ports["/skinware/foot"] = port
                return super().__iter__()

        monkeypatch.setattr(port.port, "receivers", Growing())
        assert set(there.ports()) == {"/skinware/hand"}
        assert set(there.ports()) == {"/skinware/hand", "/skinware/foot"}
        monkeypatch.undo()
        del ports["/skinware/foot"]


def test_what_is_no_skin_is_left_out_with_a_word(namespace: object, yarp: Robot) -> None:
    with contextlib.closing(Skin("hand")), served(yarp, type_name="force_z") as (there, told):
        wait_until(lambda: any("no sensors of the type 'force_z'" in event.get("why", "") for event in told))
        assert there.ports() == {}


@pytest.mark.thorough
def test_the_command(namespace: object, yarp: Robot) -> None:
    with contextlib.closing(Skin("hand")):
        with running("skin-bridge", "yarp", "--server", f"{LOCAL}:{yarp.server.port}") as bridge:
            assert bridge.wait_for("ready")["server"] == f"{LOCAL}:{yarp.server.port}"
            assert bridge.wait_for("port")["port"] == "/skinware/hand"
            status = bridge.wait_for("status", lambda event: event["ports"]["/skinware/hand"]["registered"])
            assert set(status["ports"]["/skinware/hand"]) == {"driver", "rate_hz", "registered", "values", "readers"}
        wait_until(lambda: "/skinware/hand" not in yarp.ports)


def test_wrong_use(namespace: object) -> None:
    for arguments, why in (
        (("--server", "host:x"), "--server host:x: write HOST:PORT"),
        (("--prefix", "icub"), "prefix 'icub'"),
        (("a b",), "service"),
        (("--full-scale", "0"), "full-scale"),
    ):
        done = refused("skin-bridge", "yarp", *arguments)
        assert done.returncode == 2
        assert why in done.stderr
    with pytest.raises(ConfigurationError, match="prefix"):
        YarpServer(Namespace(None), Settings(prefix="/a b"), NameServer(LOCAL, 1))


def test_a_reader_that_is_stuck_takes_nothing_from_the_others(namespace: object, yarp: Robot) -> None:
    with contextlib.closing(Skin("hand", 2000)) as skin, served(yarp, yarp=4) as (there, _):
        wait_until(lambda: "/skinware/hand" in yarp.ports)
        host, number, _ = yarp.ports["/skinware/hand"]
        with socket.create_connection((host, number), PATIENCE_S) as stuck:
            stuck.sendall(b"CONNECT stuck\nr\n")
            with emulated_skin("yarp", name="again", bus=f"yarp://{LOCAL}:{yarp.server.port}/skinware/hand") as driver:

                def stuck_misses() -> int:
                    readers = there.ports()["/skinware/hand"]["readers"]
                    return sum(reader["passed_over"] for reader in readers if reader["name"] == "stuck")

                wait_until(lambda: stuck_misses() > 20)
                skin.values = skin.values[::-1].copy()
                read_until(driver.reader, lambda f: f.values[-1] == 0 and not f.status.any())
        wait_until(lambda: [r["name"] for r in there.ports()["/skinware/hand"]["readers"]] == [])
