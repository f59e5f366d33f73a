"""Every public error, produced, says what docs/reference/errors.md says of it."""

from __future__ import annotations

import asyncio
import importlib
import inspect
import os
import re
import resource
import sys
import threading
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import zenoh
from serial.tools import list_ports

import skinware.recording
from skinware import DriverReader, Namespace, Sample, ServiceReader, ServiceWriter, errors, native
from skinware.bridge.endpoints import endpoints
from skinware.bridge.link import ZenohLink
from skinware.errors import SkinwareError
from skinware.memory.ring import slot_headers_of
from skinware.realtime import Profile
from skinware.recording import open as open_recording
from skinware.sensor_types import PRESSURE
from skinware_drivers.cli.driver_setup import ConfigFile
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.fields import Match
from skinware_drivers.link import Link
from skinware_drivers.registry import make_bus
from skinware_drivers.running.guard import hook
from skinware_drivers.virtual.bus import VirtualCanBus
from tests.sdk.driving import Chatter

PAGE = Path(__file__).parent.parent / "docs/reference/errors.md"
COLUMNS = {"values": ("<u4", 4)}
Produce = Callable[[pytest.MonkeyPatch], object]
PRODUCERS: dict[str, Produce] = {}


def produces(function: Produce) -> Produce:
    """Named after the error that it produces."""
    PRODUCERS[function.__name__] = function
    return function


def writer(**more: object) -> ServiceWriter:
    return ServiceWriter("pose", COLUMNS, **more)  # type: ignore[arg-type]


def reader() -> ServiceReader[Sample]:
    return ServiceReader[Sample]("pose")


def publish(to: ServiceWriter) -> None:
    to.begin()["values"][:] = 1
    to.commit(1)


@produces
def ConfigurationError(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with TemporaryDirectory() as folder, chdir(folder):
        path = Path("torso.toml")
        path.write_text('driver = "roboskin"\n\n[[bus]]\nnmae = "can0"\n')
        return ConfigFile(path)


@produces
def StructureError(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    twice = [Patch("left", [Module(taxels(1))], key=7), Patch("right", [Module(taxels(1))], key=7)]
    return assemble([("can0", twice)], [PRESSURE], "u1")


@produces
def DriverError(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with hook("probe", "can0"):
        exec(compile(f"{37 * chr(10)}raise KeyError('board')", "my_skin.py", "exec"))
    return None


@produces
def NamespaceError(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    namespace = Namespace()
    namespace.create()
    namespace.path.chmod(0o777)
    return DriverReader("roboskin")


@produces
def BadRecording(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with TemporaryDirectory() as folder, chdir(folder):
        path = Path("walk.mcap")
        path.write_text("time,pressure")
        return open_recording(path)


@produces
def MissingExtra(monkeypatch: pytest.MonkeyPatch) -> object:  # noqa: N802
    monkeypatch.setitem(sys.modules, "mcap", None)
    return importlib.reload(skinware.recording)


@produces
def BridgeError(monkeypatch: pytest.MonkeyPatch) -> object:  # noqa: N802
    place = "tcp/127.0.0.1:47448"

    def fail(_: object) -> None:  # as zenoh 1.10, whose threads stay for good once they run
        raise zenoh.ZError(
            f"Can not create a new TCP listener bound to {place}: [127.0.0.1:47448: Address already in use (os error"
            " 98)] at io/zenoh-links/zenoh-link-tcp/src/unicast.rs:335."
        )

    monkeypatch.setattr(zenoh, "open", fail)
    return ZenohLink(endpoints(listen=[place]))


@produces
def PlatformError(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    return native.load(Path("libskinware.so"), native.FOLDERS)


@produces
def RealtimeRefused(monkeypatch: pytest.MonkeyPatch) -> object:  # noqa: N802
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (0, 0))
    return Profile(policy="fifo", priority=50, freeze_gc=False).apply(strict=True)


@produces
def ServiceNotFound(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer():
        return DriverReader("torso")


@produces
def ServiceTimeout(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer(), reader() as reading:
        return reading.read(timeout_s=0)


@produces
def NameInUse(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer():
        return writer()


@produces
def BadServiceFile(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer() as writing:
        path = writing.namespace.ring_path("pose")
        path.unlink()
        path.write_bytes(b"something else" * 100)
        try:
            return reader()
        finally:
            path.unlink()


@produces
def StructureChanged(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    first = writer()
    publish(first)
    with reader() as reading:
        first.close()
        with ServiceWriter("pose", {"values": ("<u4", 5)}) as second:
            publish(second)
            return reading.read(newer_than=reading.read(), timeout_s=5)


@produces
def Overrun(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer() as writing, reader() as reading:
        publish(writing)
        slot_headers_of(writing._ring.segment)[1][0] = 0  # as if the writer had come past each time
        return reading.read()


@produces
def Closed(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer():
        with reader() as reading:
            pass
        return reading.read()


@produces
def Paused(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer() as writing:
        writing.pause()
        return writing.begin()


def serving(ask: Callable[[ServiceReader[Sample]], object]) -> object:
    def fail() -> None:
        raise RuntimeError("the valve is stuck")

    with writer(operations={"open": fail}) as writing, reader() as reading:
        writing.request_server()

        def serve() -> None:
            for _ in writing.on_request():
                pass

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            return ask(reading)
        finally:
            writing.stop()
            thread.join()


@produces
def RequestRefused(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    return serving(lambda reading: reading.call("tare"))


@produces
def RequestFailed(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    return serving(lambda reading: reading.call("open"))


@produces
def RequestTimeout(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer(operations={"open": lambda: None}) as writing, reader() as reading:
        writing.request_server()  # which nobody attends to
        return reading.call("open", timeout_s=0.05)


@produces
def RequestCancelled(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    with writer(operations={"open": lambda: None}) as writing, reader() as reading:
        writing.request_server()
        pending = reading.ask("open")
        pending.cancel()
        return pending.result(1)


@produces
def PeerGone(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    writing = writer(operations={"open": lambda: None})
    with reader() as reading:
        writing.close()
        return reading.call("open", timeout_s=5)


@produces
def BusNotAvailable(monkeypatch: pytest.MonkeyPatch) -> object:  # noqa: N802
    monkeypatch.setattr(list_ports, "comports", list)
    bus = make_bus("/dev/ttyNONE")
    return bus.open()


@produces
def BusSendError(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    bus = VirtualCanBus("", hardware=Chatter(), listen_only=True)
    bus.open()
    try:
        bus.send(0x207, b"\x07\x00")
    finally:
        bus.close()
    return None


@produces
def HandshakeTimeout(_: pytest.MonkeyPatch) -> object:  # noqa: N802
    bus = VirtualCanBus("", hardware=Chatter())
    bus.open()
    try:
        return asyncio.run(Link(bus).request(0x207, b"\x1c\x02\x00", Match(0x270), timeout_s=0.01))
    finally:
        bus.close()


def documented() -> dict[str, str]:
    """Name of each error in the page's table, and the example of its message."""
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| .* \|$", PAGE.read_text(), re.MULTILINE)
    return {name: example.strip("*") for name, example in rows}


def public_errors() -> set[str]:
    """Those that are raised: the leaves of the tree."""
    classes = [c for _, c in inspect.getmembers(errors, inspect.isclass) if issubclass(c, SkinwareError)]
    return {c.__name__ for c in classes if not c.__subclasses__() or c.__name__ in PRODUCERS}


def test_the_page_names_every_error_and_no_other() -> None:
    assert set(documented()) == public_errors() == set(PRODUCERS)


@pytest.mark.parametrize("name", sorted(PRODUCERS))
def test_the_example_is_what_the_error_says(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(getattr(errors, name)) as found:
        PRODUCERS[name](monkeypatch)
    message = str(found.value)
    message = message.replace(Namespace().name, "default")
    assert message == documented()[name]
