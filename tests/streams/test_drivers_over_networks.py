"""Serial drivers whose devices are behind TCP and UDP, unchanged."""

from __future__ import annotations

import socket

import pytest

from skinware.driver_snapshot import DriverSnapshot
from skinware.status import BusState, PatchState
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.streams.udp import UdpPort
from skinware_drivers.testing.driving import driving_lines, emulated_on, emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.hardware import load_emulator
from tests.commands import run, running
from tests.streams.peers import LOCAL, free_port

DRIVERS = ["tactile_glove", "weiss_wts", "openpatch", "wuji_glove", "paxini"]
"""One that only listens, and three that ask, of three framings."""


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("scheme", ["tcp", "udp"])
def test_a_serial_driver_runs_unchanged(driver: str, scheme: str, namespace: object) -> None:
    port = free_port(socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM)
    speaks_first = driver == "tactile_glove"
    here, there = f"{scheme}://{LOCAL}:{port}", f"{scheme}://:{port}"
    if scheme == "udp" and speaks_first:
        here, there = there, here
    with emulated_on(make_bus(there, payload_size=4096, for_devices=True), load_emulator(driver)):
        with emulated_skin(driver, bus=here) as skin:
            read_until(skin.reader, lambda frame: (frame.patch_state == PatchState.LIVE).all())
            [bus] = skin.driver.status()["buses"]
            assert bus["frames"] > 0
            assert bus["checksum_errors"] == 0


def test_what_later_datagrams_overtook_is_not_shown_and_not_lost(
    namespace: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    send, data, late = UdpPort.write, list[bytes](), list[tuple[UdpPort, bytes]]()

    def send_each_fifth_late(port: UdpPort, datagram: bytes) -> int:
        data.append(datagram)
        if len(datagram) > 1000 and len(data) % 5 == 0:
            late.append((port, datagram))
            return len(datagram)
        sent = send(port, datagram)
        if len(data) % 5 == 2 and late:
            send(*late.pop())
        return sent

    monkeypatch.setattr(UdpPort, "write", send_each_fifth_late)
    port = free_port(socket.SOCK_DGRAM)
    bus = make_bus(f"udp://:{port}", payload_size=4096, for_devices=True)
    with emulated_on(bus, load_emulator("wuji_glove"), pattern="cycle"):
        with emulated_skin("wuji_glove", bus=f"udp://{LOCAL}:{port}") as skin:
            shown = [(0, 0.0)]

            def has_overtaken_enough(frame: DriverSnapshot) -> bool:
                shown.append((int(frame.module_time_ns[0]), float(frame.values[0])))
                return skin.reader.patch_counters(frame)[0]["sequence_back"] >= 20

            counts = skin.reader.patch_counters(read_until(skin.reader, has_overtaken_enough))[0]
    assert shown == sorted(shown)
    assert counts["sequence_lost"] <= 1  # one may be on its way
    assert counts["sequence_repeated"] == 0


def test_a_device_that_hangs_up_is_called_again_and_again(namespace: object) -> None:
    port = free_port()
    emulator = load_emulator("weiss_wts")
    driver = load_driver("weiss_wts")
    adapter = driver(driver.Options())
    bus = make_bus(f"tcp://{LOCAL}:{port}", payload_size=adapter.payload_size)
    device = f"tcp://{LOCAL}:{port}"
    with driving_lines([(adapter, bus)], "wts", wait=False, wait_for_buses=True) as driving:
        wait_until(lambda: driving.runner is not None and driving.runner.lines[0].connection.lost.is_set())
        for _ in range(2):
            with emulated_on(make_bus(device, payload_size=4096, for_devices=True), emulator):
                driving.wait()
                wait_until(lambda: driving.status()["buses"][0]["state"] == BusState.LIVE.name.lower())
            wait_until(lambda: driving.status()["buses"][0]["state"] == BusState.GONE.name.lower())


def test_the_commands_take_such_buses(namespace: object) -> None:
    with running("skin-emulate", "--driver", "tactile_glove", "--bus", f"tcp://{LOCAL}:0") as device:
        where = device.wait_for("ready")["note"].removeprefix("listens on ")
        with running("skin-driver", "--driver", "tactile_glove", "--bus", f"tcp://{where}") as driver:
            driver.wait_for("status", lambda event: event["buses"][0]["state"] == "live")


@pytest.mark.thorough
def test_a_driver_of_can_takes_the_datagrams_of_its_hand(namespace: object) -> None:
    port = free_port(socket.SOCK_DGRAM)
    with running("skin-driver", "--driver", "allegro_v5", "--bus", f"udp://:{port}", "--side", "left") as driver:
        with running("skin-emulate", "--driver", "allegro_v5_udp", "--bus", f"udp://{LOCAL}:{port}"):
            status = driver.wait_for("status", lambda event: event["buses"][0]["state"] == "live")
            assert status["buses"][0]["bad_content"] == status["buses"][0]["bad_length"] == 0


@pytest.mark.thorough
def test_what_is_no_bus_of_this_kind_is_said_to_be_none(namespace: object) -> None:
    refused = run("skin-driver", "--driver", "roboskin", "--bus", f"tcp://{LOCAL}:9")
    assert refused.returncode == 2
    assert "needs a CAN bus" in refused.stderr
    absent = run("skin-driver", "--driver", "tactile_glove", "--bus", f"tcp://{LOCAL}:{free_port()}")
    assert absent.returncode == 1
    assert "nothing listens at this port" in absent.stderr
    no_can = run("skin-dump", "--raw", f"tcp://{LOCAL}:9")
    assert no_can.returncode == 2
    assert "one owner" in no_can.stderr


@pytest.mark.thorough
def test_who_is_behind_a_connection_is_asked_only_on_request(namespace: object) -> None:
    device = make_bus(f"tcp://{LOCAL}:{(port := free_port())}", payload_size=4096, for_devices=True)
    with emulated_on(device, load_emulator("weiss_wts")):
        looked = run("skin-find", f"tcp://{LOCAL}:{port}")
        assert (looked.returncode, "not opened" in looked.stdout) == (0, True), looked.stderr
        assert device.counters.framing.bytes_in == 0
        asked = run("skin-find", f"tcp://{LOCAL}:{port}", "--probe", "--driver", "weiss_wts")
        assert "answers: WTS with" in asked.stdout
