"""The commands, over real connections of this machine."""

from __future__ import annotations

import os
import random
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import trustme

from skinware import DriverReader, DriverWriter
from skinware.errors import RequestFailed
from skinware.memory.announcement import sweep
from skinware.memory.namespace import Namespace
from skinware_drivers.testing.plugin import files_left
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.rig import publish, structure
from tests.bridge.slow import slow_link
from tests.commands import PATIENCE_S, Running, running
from tests.streams.peers import free_port

ROBOT = "walle"


@pytest.fixture
def here(namespace: Namespace) -> Iterator[Namespace]:
    """The namespace in which the robot appears; nothing is left in it."""
    place = Namespace(f"{namespace.name}-here")
    yield place
    left = files_left(place.path)
    shutil.rmtree(place.path, ignore_errors=True)
    assert not left


@contextmanager
def driver(namespace: Namespace, sensors: int = 64, rate_hz: float = 50) -> Iterator[DriverWriter]:
    """One that publishes by itself; the value of a frame is its sequence."""
    with DriverWriter("arm", structure(sensors), namespace=namespace, rate_hz=rate_hz) as writer:
        ended = threading.Event()

        def work() -> None:
            while not ended.wait(1 / rate_hz):
                publish(writer)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield writer
        finally:
            ended.set()
            thread.join()


def serving(port: int, *options: str) -> Any:
    return running("skin-bridge", "serve", "--robot", ROBOT, "--listen", f"tcp/127.0.0.1:{port}", *options)


def joining(port: int, here: Namespace, *options: str) -> Any:
    return running("skin-bridge", "join", ROBOT, "--connect", f"tcp/127.0.0.1:{port}", "--into", here.name, *options)


def status(join: Running, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """A status of a joiner that fulfils a condition on its service."""

    def fulfils(event: dict[str, Any]) -> bool:
        return "arm" in event["services"] and condition(event["services"]["arm"])

    return join.wait_for("status", fulfils)


@pytest.mark.thorough
def test_two_commands_are_enough(namespace: Namespace, here: Namespace) -> None:
    with driver(namespace), serving(port := free_port()) as serve, joining(port, here) as join:
        assert serve.wait_for("ready")["listen"] == [f"tcp/127.0.0.1:{port}"]
        assert join.wait_for("ready")["namespace"] == here.name
        told = status(join, lambda arm: arm["state"] == "live" and arm["rate_hz"] > 10)
        assert told["connected"]
        assert told["clock"]["error_ms"] > 0
        with DriverReader("arm", namespace=here) as reader:
            frame = reader.read()
            assert frame.fresh("pressure", at_ns=frame.acquired_ns).all()
            assert (frame.values == frame.values[0]).all()
        assert serve.wait_for("status", lambda event: "arm" in event["services"])["missed"] == 0


@pytest.mark.thorough
def test_the_clock_of_the_same_machine_is_found_to_be_the_same(namespace: Namespace, here: Namespace) -> None:
    with driver(namespace), serving(port := free_port()), joining(port, here) as join:
        told = join.wait_for("status", lambda event: bool(event["clock"]) and event["clock"]["error_ms"] < 5)
        assert abs(told["clock"]["offset_ms"]) <= told["clock"]["error_ms"]


@pytest.mark.parametrize(
    ("how", "end"),
    [
        ("killed", "serve"),
        *(pytest.param(*case, marks=pytest.mark.thorough) for case in (("killed", "join"), ("stopped", "serve"))),
        ("stopped", "join"),
    ],
)
def test_either_end_goes_and_comes_back(namespace: Namespace, here: Namespace, end: str, how: str) -> None:
    port, generator = free_port(), random.Random(3)
    with driver(namespace), ExitStack() as stack:
        commands = {
            "serve": stack.enter_context(serving(port)),
            "join": stack.enter_context(joining(port, here)),
        }
        status(commands["join"], lambda arm: arm["rate_hz"] > 10)
        with DriverReader("arm", namespace=here) as reader:
            for _ in range(2):
                time.sleep(generator.random() / 5)
                process = commands[end].process
                if how == "stopped":
                    os.kill(process.pid, signal.SIGSTOP)
                else:
                    process.kill()
                    commands[end].stop()
                wait_until(lambda: not reader.read().fresh("pressure").any())
                if how == "stopped":
                    os.kill(process.pid, signal.SIGCONT)
                else:
                    again = serving(port) if end == "serve" else joining(port, here)
                    commands[end] = stack.enter_context(again)
                wait_until(lambda: bool(reader.read().fresh("pressure").all()))
            values = reader.read().values
            assert (values == values[0]).all()
            sweep(namespace)


@pytest.mark.thorough
def test_a_slow_link_has_the_newest_and_a_fast_one_has_all(namespace: Namespace, here: Namespace) -> None:
    """Frames of 30,848 sensors take twenty times what the link has."""
    port = free_port()
    beside = Namespace(f"{namespace.name}-beside")
    with driver(namespace, 30_848, 50), serving(port), slow_link(port, 4e6) as slow, joining(port, beside) as fast:
        with joining(slow.port, here) as join:
            status(join, lambda arm: arm["mode"] == "pull" and arm["rate_hz"] > 0)
            status(join, lambda arm: arm["mode"] == "pull" and arm["age_ms"]["p50"] < 1000)
            begin = status(fast, lambda arm: arm["mode"] == "push")["services"]["arm"]["gap"]
            slow_begin = status(join, lambda _: True)["services"]["arm"]["gap"]
            status(join, lambda arm: arm["gap"] > slow_begin + 200)
            lost = status(fast, lambda _: True)["services"]["arm"]["gap"] - begin
            assert lost < 20  # 0 on a quiet machine (tools/bench bridge)
    shutil.rmtree(beside.path, ignore_errors=True)


@pytest.mark.thorough
def test_a_link_with_a_long_delay_passes_all_frames(namespace: Namespace, here: Namespace) -> None:
    port = free_port()
    with driver(namespace, 64, 20), serving(port), slow_link(port, 1e9, 0.8) as slow, joining(slow.port, here) as join:
        status(join, lambda arm: arm["rate_hz"] > 15)
        slow.flows.clear()
        lost = join.wait_for("disconnected")
        assert "no answer for " in lost["why"]
        slow.flows.set()


def certificates(authority: trustme.CA, folder: Path, name: str) -> str:
    """A folder with a certificate of an authority."""
    made = authority.issue_cert("127.0.0.1", common_name=name)
    folder.mkdir()
    authority.cert_pem.write_to_path(folder / "ca.pem")
    made.private_key_pem.write_to_path(folder / "key.pem")
    (folder / "cert.pem").write_bytes(b"".join(blob.bytes() for blob in made.cert_chain_pems))
    return str(folder)


@pytest.mark.thorough
def test_only_who_has_a_certificate_sees_and_only_who_is_named_calls(
    namespace: Namespace, here: Namespace, tmp_path: Path
) -> None:
    authority, other = trustme.CA(), trustme.CA()
    folders = {name: certificates(authority, tmp_path / name, name) for name in ("robot", "operator", "guest")}
    stranger = certificates(other, tmp_path / "stranger", "operator")
    port = free_port()
    with (
        running("skin-driver", "--bus", "virtual", "--name", "arm") as _,
        serving(port, "--tls", folders["robot"], "--caller", "operator"),
    ):
        with joining(port, here, "--tls", folders["guest"]) as join:
            status(join, lambda arm: arm["rate_hz"] > 0)
            with DriverReader("arm", namespace=here) as reader:
                with pytest.raises(RequestFailed, match="it lets only operator call"):
                    reader.call("versions", timeout_s=PATIENCE_S)
        with joining(port, here, "--tls", folders["operator"]) as join:
            status(join, lambda arm: arm["rate_hz"] > 0)
            with DriverReader("arm", namespace=here) as reader:
                assert reader.call("versions", timeout_s=PATIENCE_S)
        with joining(port, here, "--tls", stranger) as join:
            assert "its certificate is not accepted here" in join.wait_for("trouble")["why"]
        with joining(port, here) as join:
            assert "does it want --tls?" in join.wait_for("trouble")["why"]


@pytest.mark.thorough
def test_a_robot_that_is_not_there_is_named(namespace: Namespace, here: Namespace) -> None:
    port = free_port()
    with running("skin-bridge", "join", "eve", "--connect", f"tcp/127.0.0.1:{port}", "--into", here.name) as join:
        assert "nothing listens there" in join.wait_for("trouble")["why"]
        with serving(port):
            join.wait_for("trouble", lambda event: "listens there, but" in event["why"] and ROBOT in event["why"])
