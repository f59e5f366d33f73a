"""Robots that are reached through routers: the commands, over real connections of this machine."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import trustme

from skinware import DriverReader
from skinware.bridge.endpoints import Rules, endpoints
from skinware.errors import ConfigurationError, RequestFailed
from skinware.memory.namespace import Namespace
from skinware.service import ServiceReader, ServiceWriter
from skinware_drivers.testing.plugin import files_left
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.test_over_zenoh import certificates, driver
from tests.commands import PATIENCE_S, Running, run, running
from tests.streams.peers import free_port


@contextmanager
def place(namespace: Namespace, name: str) -> Iterator[Namespace]:
    """A namespace in which nothing is left."""
    here = Namespace(f"{namespace.name}-{name}")
    try:
        yield here
    finally:
        left = files_left(here.path)
        shutil.rmtree(here.path, ignore_errors=True)
        assert not left


def at(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"


def serving(robot: str, namespace: Namespace, port: int, *options: str) -> Any:
    where = ("--namespace", namespace.name, "--connect", at(port))
    return running("skin-bridge", "serve", "--robot", robot, *where, *options)


def joining(robot: str, here: Namespace, port: int, *options: str) -> Any:
    return running("skin-bridge", "join", robot, "--connect", at(port), "--into", here.name, *options)


def listing(port: int, *options: str) -> Any:
    return running("skin-bridge", "list", "--connect", at(port), "--watch", *options)


@contextmanager
def pump(namespace: Namespace) -> Iterator[None]:

    def tare() -> str:
        """Take the present load as none."""
        return "tared"

    with ServiceWriter("pump", {"x": ("<f8", 1)}, namespace=namespace, operations={"tare": tare}, rate_hz=50) as writer:

        def work() -> None:
            for columns in writer.periodic(50):
                columns["x"][:] = 1.0

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield
        finally:
            writer.stop()
            thread.join()


def until_told(listed: Running, *robots: str) -> dict[str, Any]:
    """Until a list has these robots, each with its drivers."""
    return listed.wait_for(
        "status", lambda event: tuple(each["robot"] for each in event["robots"] if "drivers" in each) == robots
    )


@pytest.mark.thorough
def test_robots_of_two_labs_meet(namespace: Namespace) -> None:
    lab, other_lab = free_port(), free_port()
    with place(namespace, "other") as other, place(namespace, "here") as here, driver(other), pump(other):
        with (
            serving("walle", other, other_lab),  # before there is anybody to call
            running("skin-bridge", "route", "--listen", at(lab)) as route,
            running("skin-bridge", "route", "--listen", at(other_lab), "--connect", at(lab)),
            listing(lab) as listed,
            joining("walle", here, lab),
        ):
            with serving("icub", namespace, lab):
                found = until_told(listed, "icub", "walle")
                assert found["robots"][1]["drivers"]["arm"]["sensors"] == 64
                assert found["problems"] == []
            until_told(listed, "walle")
            route.wait_for("status", lambda event: event["robots"] == {"walle": 1})
            with DriverReader("arm", namespace=here, timeout_s=PATIENCE_S) as arm:
                wait_until(
                    lambda: arm.newest_position is not None and bool(arm.read().fresh("pressure").all()), PATIENCE_S
                )
            with ServiceReader("pump", namespace=here, timeout_s=PATIENCE_S) as service:
                assert service.call("tare", timeout_s=PATIENCE_S) == "tared"


@pytest.mark.thorough
def test_a_router_says_who_may_serve_and_who_may_call(namespace: Namespace, tmp_path: Path) -> None:
    authority, port = trustme.CA(), free_port()
    tls = {name: ("--tls", certificates(authority, tmp_path / name, name)) for name in ("router", "icub", "guest")}
    rules = ("--caller", "icub", "--robot", "icub")
    with (
        place(namespace, "other") as other,
        place(namespace, "here") as here,
        pump(namespace),
        running("skin-bridge", "route", "--listen", at(port), *rules, *tls["router"]) as route,
        serving("icub", other, port, *tls["guest"]),
        serving("walle", other, port, *tls["icub"]),
        serving("icub", namespace, port, *tls["icub"]),
        listing(port, *tls["guest"]) as listed,
    ):
        found = until_told(listed, "icub")
        assert [robot["namespace"] for robot in found["robots"]] == [namespace.name], "others do not serve it"
        route.wait_for("status", lambda event: event["robots"] == {"icub": 1})
        for who in ("guest", "icub"):
            with joining("icub", here, port, *tls[who]):
                with ServiceReader("pump", namespace=here, timeout_s=PATIENCE_S) as service:
                    wait_until(lambda service=service: service.newest_position is not None, PATIENCE_S)  # type: ignore[misc]
                    if who == "guest":
                        with pytest.raises(RequestFailed, match="no answer from robot icub"):
                            service.call("tare", timeout_s=PATIENCE_S)
                    else:
                        assert service.call("tare", timeout_s=PATIENCE_S) == "tared"


@pytest.mark.thorough
def test_who_nobody_answers_is_told_why() -> None:
    ended = run("skin-bridge", "list", "--connect", at(free_port()))
    assert ended.returncode == 1
    assert "nothing listens there" in ended.stderr


def test_names_need_certificates() -> None:
    for rules in (Rules(robots=["icub"], routes=True), Rules(routers=["lab"], routes=True)):
        with pytest.raises(ConfigurationError, match="give --tls, too"):
            endpoints(listen=[at(7447)], rules=rules)
    with pytest.raises(ConfigurationError, match="give --tls DIR, or --insecure"):
        endpoints(listen=["tcp/0.0.0.0:7447"], rules=Rules(routes=True))
