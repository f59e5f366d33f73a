"""What happens to CAN buses of a kernel, and what a driver then says: state, reason, and that it is never the end.

Every test has a second bus in order, which nothing may hold up.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import socket
import struct
import subprocess
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skinware import BusReason, BusState, DriverReader, DriverSnapshot, Status
from skinware.errors import BusNotAvailable, BusSendError
from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG, FrameBatch
from skinware_drivers.can.controller import read_controller
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip
from tests.can.rig import TIP_IDENTIFIER, can_frame, sender, skin
from tests.sdk.driving import follow, read_until

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]

TIOCSETD, N_SLCAN, SIOCGIFNAME = 0x5423, 17, 0x8910
FIRST, SECOND = slice(0, 8), slice(8, 16)


def is_fresh(frame: DriverSnapshot, part: slice = slice(None)) -> bool:
    return not frame.status[part].any()


def is_in_order(frame: DriverSnapshot) -> bool:
    return is_fresh(frame) and frame.bus_state.tolist() == [BusState.LIVE] * 2 and not frame.bus_reason.any()


def goes_on_without(frame: DriverSnapshot, reason: BusReason, state: BusState) -> bool:
    """The first bus is in this state and shows nothing as fresh; the second one lives."""
    told = (frame.bus_state[0], frame.bus_reason[0]) == (state, reason)
    return told and bool((frame.status[FIRST] & Status.STALE).all()) and is_fresh(frame, SECOND)


@pytest.mark.quick
def test_set_down_and_up(vcan: Callable[[], str], caplog: pytest.LogCaptureFixture) -> None:
    name = vcan()
    with caplog.at_level(logging.WARNING), skin(name, vcan()), DriverReader("tip") as reader:
        first = read_until(reader, is_in_order)
        ip("link", "set", name, "down")
        down = read_until(reader, lambda f: goes_on_without(f, BusReason.INTERFACE_DOWN, BusState.DOWN))
        assert first.published_ns < down.bus_since_ns[0] < down.published_ns
        ip("link", "set", name, "up")
        back = read_until(reader, is_in_order)
        assert back.generation == first.generation
    assert caplog.text.count(f"bus {name} went down; waiting") == 1
    assert caplog.text.count(f"bus {name} is back") == 1


def test_deleted_and_made_again(vcan: Callable[[], str]) -> None:
    name = vcan()
    with skin(name, vcan()), DriverReader("tip") as reader:
        read_until(reader, is_in_order)
        ip("link", "del", name)
        read_until(reader, lambda f: goes_on_without(f, BusReason.INTERFACE_GONE, BusState.GONE))
        ip("link", "add", "dev", name, "type", "vcan")
        ip("link", "set", name, "up")
        read_until(reader, is_in_order)


def test_not_there_when_the_driver_starts(vcan: Callable[[], str]) -> None:
    name = vcan()
    ip("link", "del", name)
    with skin(name, vcan()), DriverReader("tip") as reader:
        alone = read_until(reader, lambda f: is_fresh(f) and f.bus_state[1] == BusState.LIVE)
        assert (alone.bus_state[0], alone.bus_reason[0]) == (BusState.GONE, BusReason.INTERFACE_GONE)
        ip("link", "add", "dev", name, "type", "vcan")
        ip("link", "set", name, "up")
        both = follow(reader, is_in_order)
        assert both.structure.n_patches == 2


def test_the_one_report_of_a_loss_went_to_a_send(vcan: Callable[[], str]) -> None:
    """The kernel tells it once: if a send takes it, no receive ever fails, and the old socket stays deaf."""
    name = vcan()
    with skin(name, vcan()) as (driver, tips), DriverReader("tip") as reader:
        read_until(reader, is_in_order)
        tips.silent.add(name)
        read_until(reader, lambda f: f.bus_state[0] == BusState.SILENT)

        assert driver.runner is not None
        bus = driver.runner.lines[0].bus

        def lose() -> None:
            ip("link", "del", name)
            for _ in range(3):  # the report of "down", that of "gone", then "no such device"
                with pytest.raises(BusSendError):
                    bus.send(0x1, b"")
            ip("link", "add", "dev", name, "type", "vcan")
            ip("link", "set", name, "up")

        driver.do(lose)
        tips.silent.clear()
        read_until(reader, is_in_order)


@pytest.fixture
def unbound_controller(can_pair: tuple[str, str]) -> Iterator[tuple[str, Callable[[], None], Callable[[], None]]]:
    """can0, a function that takes its hardware away, and one that brings it back."""
    device = Path("/sys/class/net/can0/device").resolve().name
    driver = Path("/sys/bus/pci/drivers/kvaser_pci")

    def bind() -> None:
        (driver / "bind").write_text(device)
        wait_until(lambda: Path("/sys/class/net/can0").exists())
        ip("link", "set", "can0", "type", "can", "bitrate", "1000000")
        ip("link", "set", "can0", "up")

    def unbind() -> None:
        (driver / "unbind").write_text(device)

    yield can_pair[0], unbind, bind
    if not Path("/sys/class/net/can0").exists():
        bind()


def test_a_controller_that_is_taken_out_and_put_back(
    unbound_controller: tuple[str, Callable[[], None], Callable[[], None]], vcan: Callable[[], str]
) -> None:
    name, unbind, bind = unbound_controller
    with skin("can1", vcan()) as (_, tips), DriverReader("tip") as reader:  # can1 hears what can0 sends
        tips._interfaces[0] = name
        read_until(reader, is_in_order)
    with skin(name, vcan()) as (_, tips), DriverReader("tip") as reader:
        tips._interfaces[0] = "can1"
        read_until(reader, is_in_order)
        unbind()
        read_until(reader, lambda f: goes_on_without(f, BusReason.INTERFACE_GONE, BusState.GONE))
        bind()
        read_until(reader, is_in_order)


def test_a_network_namespace_that_vanishes(vcan: Callable[[], str]) -> None:
    name, place = f"vx{os.getpid() % 10000}", f"place{os.getpid()}"

    def make() -> None:
        ip("netns", "add", place)
        ip("link", "add", name, "type", "vxcan", "peer", "name", "inside", "netns", place)
        ip("-n", place, "link", "set", "inside", "up")
        ip("link", "set", name, "up")

    make()
    try:
        with skin(name, vcan()), DriverReader("tip") as reader:
            read_until(reader, is_in_order)
            ip("netns", "del", place)
            read_until(reader, lambda f: goes_on_without(f, BusReason.INTERFACE_GONE, BusState.GONE))
            make()
            read_until(reader, is_in_order)
    finally:
        subprocess.run(["ip", "netns", "del", place], capture_output=True)


@pytest.mark.parametrize(
    ("kind", "detail", "reason"),
    [
        (0x4, "0004000000000000", BusReason.ERROR_WARNING),
        (0x4, "0020000000000000", BusReason.ERROR_PASSIVE),
        (0x4, "0001000000000000", BusReason.OVERFLOW),
        (0x20, "0000000000000000", BusReason.NO_ACKNOWLEDGEMENT),
        (0x88, "0000040A00000000", BusReason.BUS_ERRORS),
    ],
)
def test_error_frames_become_a_reason(vcan: Callable[[], str], kind: int, detail: str, reason: BusReason) -> None:
    name = vcan()
    with skin(name, vcan()) as (driver, _), DriverReader("tip") as reader, sender(name) as out:
        read_until(reader, is_in_order)
        out.send(can_frame(ERROR_FLAG | kind, bytes.fromhex(detail)))
        frame = read_until(reader, lambda f: f.bus_reason[0] == reason and is_fresh(f))
        assert (frame.bus_state[0], frame.bus_reason[1]) == (BusState.LIVE, BusReason.NONE)
        out.send(can_frame(ERROR_FLAG | 0x4, bytes.fromhex("0040000000000000")))
        read_until(reader, is_in_order)
        assert driver.status()["buses"][0]["errors"] == 2


@pytest.mark.quick
@pytest.mark.parametrize("restarted", [True, False])
def test_bus_off_and_the_way_back(vcan: Callable[[], str], caplog: pytest.LogCaptureFixture, restarted: bool) -> None:
    name = vcan()
    with caplog.at_level(logging.WARNING), skin(name, vcan()) as (driver, tips), DriverReader("tip") as reader:
        read_until(reader, is_in_order)
        tips.silent.add(name)
        with sender(name) as out:
            read_until(reader, lambda f: f.bus_state[0] == BusState.SILENT)
            out.send(can_frame(ERROR_FLAG | 0x40, bytes(8)))
            off = read_until(reader, lambda f: goes_on_without(f, BusReason.BUS_OFF, BusState.DOWN))
            later = read_until(reader, lambda f: f.sequence >= off.sequence + 5)
            assert later.bus_since_ns[0] == off.bus_since_ns[0]
            shown = driver.status()["buses"][0]
            assert (shown["state"], shown["reason"], shown["bus_offs"]) == ("down", "bus_off", 1)
            if restarted:
                out.send(can_frame(ERROR_FLAG | 0x100, bytes(8)))
                read_until(reader, lambda f: (f.bus_state[0], f.bus_reason[0]) == (BusState.SILENT, 1))
        tips.silent.clear()
        read_until(reader, is_in_order)
    assert caplog.text.count("bus-off: ") == 1


@pytest.mark.quick
def test_frames_that_do_not_fit_are_counted_and_disturb_nothing(vcan: Callable[[], str]) -> None:
    name = vcan()
    with skin(name, vcan()) as (driver, _), DriverReader("tip") as reader, sender(name) as out:
        read_until(reader, is_in_order)
        before = driver.status()["buses"][0]
        out.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        for length in range(8):
            out.send(can_frame(TIP_IDENTIFIER, bytes(length)))
        out.send(can_frame(REMOTE_FLAG | TIP_IDENTIFIER, b""))
        out.send(struct.pack("=IBB2x64s", TIP_IDENTIFIER, 64, 4, bytes(64)))
        out.send(struct.pack("=IBB2x64s", TIP_IDENTIFIER, 8, 4, bytes(64)))
        out.send(can_frame(0x80000000 | TIP_IDENTIFIER, bytes(8)))
        wait_until(lambda: driver.status()["buses"][0]["unknown"] > before["unknown"])
        shown = driver.status()["buses"][0]
        names = ("bad_length", "refused", "unknown", "dropped", "errors")
        counted = {name: shown[name] - before[name] for name in names}
        assert counted == {"bad_length": 8, "refused": 3, "unknown": 1, "dropped": 0, "errors": 0}
        read_until(reader, is_in_order)


def test_a_babbling_node_and_foreign_traffic_cost_no_data(vcan: Callable[[], str]) -> None:
    name = vcan()
    foreign = [can_frame(identifier, bytes(8)) for identifier in range(200)]
    with skin(name, vcan()) as (driver, _), DriverReader("tip") as reader, sender(name) as out:
        start = read_until(reader, is_in_order)
        sent = 0
        until_s = time.monotonic() + 3.0
        while time.monotonic() < until_s:
            for frame in foreign:
                out.send(frame)
            sent += len(foreign)
        wait_until(lambda: driver.status()["buses"][0]["unknown"] >= sent)
        shown = driver.status()["buses"][0]
        assert (shown["unknown"], shown["dropped"], shown["state"]) == (sent, 0, "live")
        assert sent > 2000
        frames = list(iter_until_now(reader, start))
        assert len(frames) > 10  # it published all the time
        assert all(len(set(shown.values[FIRST].tolist())) == 1 for shown in frames)
        read_until(reader, is_in_order)


def iter_until_now(reader: DriverReader, start: DriverSnapshot) -> Iterator[DriverSnapshot]:
    now_ns = time.monotonic_ns()
    for frame in reader.in_order(timeout_s=30):
        if frame.published_ns > now_ns:
            return
        if frame.published_ns > start.published_ns:
            yield frame


def test_a_full_send_queue_is_an_error_of_that_frame_only(
    vcan: Callable[[], str], full_queue: Callable[[str], None]
) -> None:
    bus = SocketCanBus(vcan())
    bus.open()
    full_queue(bus.channel)
    for _ in range(5):
        bus.send(0x123, bytes(8))
    with pytest.raises(BusSendError, match=os.strerror(errno.ENOBUFS)):
        bus.send(0x123, bytes(8))
    assert (bus.counters.sent, bus.counters.send_failures) == (5, 1)
    subprocess.run(["tc", "qdisc", "del", "dev", bus.channel, "root"], check=True)
    bus.send(0x123, bytes(8))
    bus.check()
    bus.close()


def test_the_kernel_tells_of_its_controllers(can_pair: tuple[str, str], vcan: Callable[[], str]) -> None:
    shown = subprocess.run(["ip", "-json", "-details", "link", "show", can_pair[0]], check=True, capture_output=True)
    data = json.loads(shown.stdout)[0]["linkinfo"]["info_data"]
    assert data["state"] == "ERROR-ACTIVE"
    controller = read_controller(can_pair[0])
    assert controller is not None
    assert (controller.bit_rate, controller.state, controller.restart_ms) == (1_000_000, 0, data.get("restart_ms", 0))
    assert read_controller(vcan()) is None
    bus = SocketCanBus(can_pair[0])
    bus.open()
    assert "type can restart-ms 100" in bus.note
    bus.close()
    ip("link", "set", can_pair[0], "down")
    ip("link", "set", can_pair[0], "type", "can", "restart-ms", "100")
    ip("link", "set", can_pair[0], "up")
    bus.open()
    assert "restart-ms" not in bus.note
    bus.close()
    ip("link", "set", can_pair[0], "down")
    ip("link", "set", can_pair[0], "type", "can", "restart-ms", "0")


@pytest.mark.usefixtures("vcan")
def test_an_adapter_of_the_slcan_line_discipline_that_is_unplugged() -> None:
    """What slcand does, on a pty."""
    ours, theirs = os.openpty()
    try:
        tty.setraw(theirs)
        fcntl.ioctl(theirs, TIOCSETD, struct.pack("=i", N_SLCAN))
        name = fcntl.ioctl(theirs, SIOCGIFNAME, bytes(40))[:16].split(b"\0")[0].decode()
        ip("link", "set", name, "up")
        bus = SocketCanBus(name)
        bus.open()
        batch = FrameBatch(10)
        os.write(ours, b"\xff\x00garbage\rt47380001020304050607\r")
        wait_until(lambda: bus.receive(batch, 0) >= 0 and len(batch) > 0)
        wire = batch.wire[batch.start]
        assert (wire["identifier"], wire["payload"].tolist()) == (0x473, list(range(8)))
        os.close(ours)
        ours = -1
        os.close(theirs)
        theirs = -1
        with pytest.raises(BusNotAvailable) as caught:
            wait_until(lambda: bus.receive(batch, 0) > 0)
        assert caught.value.reason in (BusReason.INTERFACE_DOWN, BusReason.INTERFACE_GONE)
        bus.close()
        wait_until(lambda: not Path(f"/sys/class/net/{name}").exists())
        with pytest.raises(BusNotAvailable) as caught:
            bus.open()
        assert caught.value.reason == BusReason.INTERFACE_GONE
    finally:
        for descriptor in (ours, theirs):
            if descriptor >= 0:
                os.close(descriptor)


def test_what_the_machine_drops_before_any_socket_is_told_apart(
    can_pair: tuple[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    """A queue of one packet between the controller's interrupt, which takes several frames, and the sockets."""
    setting = Path("/proc/sys/net/core/netdev_max_backlog")
    before = setting.read_text()
    with caplog.at_level(logging.WARNING), skin(can_pair[0]) as (driver, tips), sender(can_pair[1]) as out:
        tips._interfaces[0] = can_pair[1]
        setting.write_text("0")
        try:

            def is_dropped() -> bool:
                for _ in range(200):
                    with contextlib.suppress(OSError):  # the queue of the sending controller may be full
                        out.send(can_frame(0x100, bytes(8)))
                return bool(driver.status()["machine"]["softnet_dropped"])

            wait_until(is_dropped, 60)
        finally:
            setting.write_text(before)
        (bus,) = driver.status()["buses"]
        assert bus["dropped"] == 0  # the socket knows nothing of it
        wait_until(lambda: driver.status()["buses"][0]["load"] is not None, 60)
    assert caplog.text.count("before any socket saw them") == 1
