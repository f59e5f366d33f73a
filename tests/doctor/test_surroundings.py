"""``skin-doctor`` beside the skin: interfaces and ports, the machine, namespaces, programs."""

from __future__ import annotations

import dataclasses
import os
import threading
from pathlib import Path

import pytest

from skinware import DriverReader, Namespace
from skinware_drivers.can.controller import Controller
from skinware_drivers.doctor import looking
from skinware_drivers.doctor.evidence import Evidence, MachineSeen
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.looking import look
from skinware_drivers.doctor.rules import Finding, Severity
from skinware_drivers.finding import interfaces, ports
from skinware_drivers.finding.interfaces import CanInterface, can_interfaces
from skinware_drivers.finding.ports import serial_ports
from skinware_drivers.finding.running import RunningDriver
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import running
from tests.doctor.rig import found, found_until, looked, of
from tests.finding.fakes import CONTROLLER, FakeMachine, add_interface, write


def evidence(**changes: object) -> Evidence:
    """Return the evidence of a machine without faults, with some changes."""
    return dataclasses.replace(looked(0.0), **changes)  # type: ignore[arg-type]


def findings(seen: Evidence, area: str) -> list[Finding]:
    return [finding for finding in examine(seen).findings if finding.area == area]


def machine(**changes: object) -> MachineSeen:
    return dataclasses.replace(looking.MachineWatch().seen(), **changes)  # type: ignore[arg-type]


def can(root: Path, **controllers: Controller) -> list[CanInterface]:
    return can_interfaces(root, lambda name: ("can", controllers[name]))


# -- interfaces -----------------------------------------------------------------------------------------------------


def test_interfaces_that_are_down_off_the_bus_or_lose_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_interface(tmp_path, "can0", driver="peak_usb", flags=0x1002)
    add_interface(tmp_path, "can1", flags=0x1003)
    add_interface(tmp_path, "can2", flags=0x1003)
    off_bus = dataclasses.replace(CONTROLLER, state=3, restart_ms=0)
    looks = iter(range(100))

    def interfaces_now() -> list[CanInterface]:
        number = next(looks)
        write(tmp_path / "class/net/can2/statistics", rx_dropped=3 * number, rx_packets=1000 * number)
        return can(tmp_path, can0=CONTROLLER, can1=off_bus, can2=CONTROLLER)

    monkeypatch.setattr(interfaces, "can_interfaces", interfaces_now)
    monkeypatch.setattr(interfaces, "kernel_has_can", lambda: True)
    seen = looked(0.0)
    told = {(one.where, one.what): one for one in findings(seen, "interfaces")}
    down = told["can0", "the interface is down"]
    assert (down.severity, down.commands) == (Severity.NOTE, ("sudo ip link set can0 up",))
    owner = RunningDriver("torso", "default", "roboskin", 17, ("can0",))
    used = findings(dataclasses.replace(seen, running=(owner,)), "interfaces")
    assert next(one for one in used if one.what == "the interface is down").severity == Severity.ERROR
    off = [one for one in told.values() if one.where == "can1"]
    assert {one.severity for one in off} == {Severity.ERROR}
    assert (
        "sudo ip link set can1 down",
        "sudo ip link set can1 type can restart-ms 100",
        "sudo ip link set can1 up",
    ) in {one.commands for one in off}
    dropped = told["can2", "the kernel dropped frames that it had received"]
    assert dropped.evidence == "rx dropped 3 in 0.0 s, 1,000 frames"
    as_seen = {one.what: one.seen for one in examine(seen).looked}
    assert as_seen["can0"].startswith("down, can, 1000 kbit/s, error-active, restart-ms 100, queue 10")


def test_an_interface_that_was_never_configured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_interface(tmp_path, "can0", driver="peak_usb", flags=0x1002)
    stopped = Controller(state=4, restart_ms=100)
    monkeypatch.setattr(interfaces, "can_interfaces", lambda: can(tmp_path, can0=stopped))
    monkeypatch.setattr(interfaces, "kernel_has_can", lambda: True)
    (finding,) = findings(looked(0.0), "interfaces")
    assert finding.commands[0] == "sudo ip link set can0 type can bitrate 1000000 restart-ms 100"
    assert "no bit rate" in finding.evidence


def test_a_kernel_without_can_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interfaces, "kernel_has_can", lambda: False)
    told = examine(looked(0.0)).not_looked
    assert next(one for one in told if one.what == "CAN interfaces").commands == ("sudo modprobe can-raw",)


def test_ports_that_may_not_be_opened_or_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeMachine(tmp_path)
    taken = fake.add_usb_port("ttyUSB0", "ftdi_sio", "0403", "6001", "A50285BI")
    refused = fake.add_usb_port("ttyACM0", "cdc_acm", "2341", "0043", place="1-1.3")
    fake.add_uart("ttyS0", 4)
    fake.add_process(17, "minicom", taken)
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != refused and allowed(path, mode))
    monkeypatch.setattr(ports, "serial_ports", lambda: serial_ports(fake.machine))
    seen = looked(0.0)
    told = {one.where: one for one in findings(seen, "interfaces")}
    assert set(told) == {str(taken), str(refused)}
    assert told[str(taken)].evidence.endswith("minicom, pid 17")
    assert told[str(taken)].severity == Severity.NOTE
    assert told[str(refused)].severity == Severity.WARNING
    as_seen = {one.what: one.seen for one in examine(seen).looked}
    assert "latency timer 16 ms" in as_seen[str(taken)]
    assert "no fixed name (udev)" in as_seen[str(refused)]


# -- the machine ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "area", "words"),
    [
        ({"softnet_dropped": 12}, "machine", "dropped before any socket received them"),
        ({"memory_bytes": 1 << 34, "memory_available_bytes": 1 << 28}, "machine", "memory is nearly full"),
        ({"shared_bytes": 1 << 26, "shared_free_bytes": 0}, "machine", "shared memory is nearly full"),
        ({"shared_problem": "/dev/shm: Permission denied"}, "permissions", "no driver can publish here"),
    ],
)
def test_a_machine_with_a_problem(changes: dict[str, object], area: str, words: str) -> None:
    (finding,) = findings(evidence(machine=machine(**changes)), area)
    assert words in finding.what
    assert finding.commands


@pytest.mark.parametrize(
    "changes",
    [
        {"load": 50.0, "governors": ("powersave",), "realtime_priority": 0, "locked_memory_bytes": 1 << 16},
        {"softnet_dropped": None, "memory_bytes": 0, "shared_bytes": 0},
        {"clock_set_s": 3600.0},
    ],
)
def test_circumstances_alone_are_no_finding(changes: dict[str, object]) -> None:
    seen = evidence(machine=machine(**changes))
    assert findings(seen, "machine") == findings(seen, "permissions") == []


def test_circumstances_are_the_evidence_of_what_they_cost() -> None:
    with publishing(FakeSkin("torso")):
        seen = looked()
    (driver,) = seen.drivers
    late = dataclasses.replace(driver, timing=dataclasses.replace(driver.timing, period_ns=10_000_000, missed=20))
    slow = machine(load=50.0, governors=("powersave",))
    told = findings(dataclasses.replace(seen, drivers=(late,), machine=slow), "timing")
    missed = next(one for one in told if one.what == "the driver misses periods")
    assert "20 of 40 in 0.4 s; machine load 50.0 on" in missed.evidence
    assert "normal scheduling" in missed.evidence
    assert "CPU governor powersave" in missed.evidence


# -- namespaces and programs ----------------------------------------------------------------------------------------


def test_a_driver_that_has_found_no_board_is_told() -> None:
    bus = "udp_multicast:239.74.163.9?port=43171"
    with running("skin-driver", "--bus", bus) as driver:
        pid = driver.process.pid
        wait_until(lambda: pid in looking.waiting_drivers(set()))
        wait_until(lambda: "no patch answers" in driver.errors)  # Python can lose an interrupt while it imports
        finding = found_until(of("timing", "no driver has published"), seconds=0.0)
    assert f"{pid}" in finding.evidence
    assert "has found no device so far" in finding.evidence


def test_a_program_that_does_not_keep_up(namespace: Namespace) -> None:
    stop = threading.Event()

    def read_slowly() -> None:
        with DriverReader("torso") as reader:
            for _ in reader.in_order():
                if stop.wait(0.5):
                    return

    skin = FakeSkin("torso", fake_structure(1), slots=4)
    with publishing(skin):
        thread = threading.Thread(target=read_slowly)
        thread.start()
        try:
            finding = found_until(of("timing", "does not keep up"), seconds=2.5)
        finally:
            stop.set()
            thread.join()
    assert finding.severity == Severity.WARNING
    assert f"pid {os.getpid()}" in finding.where


def test_a_calmed_driver_is_no_second_one_on_its_bus(tmp_path: Path) -> None:
    for pid, program in ((17, "skin-calm"), (18, "skin-replay"), (19, "skin-driver"), (20, "python3")):
        (tmp_path / str(pid)).mkdir()
        (tmp_path / str(pid) / "comm").write_text(f"{program}\n")
    assert [pid for pid in range(16, 22) if looking.publishes_again(pid, tmp_path)] == [17, 18]
    assert looking.waiting_drivers({20}, tmp_path) == (19,)


def test_names_of_others_cannot_move_the_cursor(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = evidence(namespace="x\x1b[2Jy\nz")
    told = examine(seen)
    texts = [
        value for note in (*told.findings, *told.looked) for value in vars(note).values() if isinstance(value, str)
    ]
    assert any("x?[2Jy?z" in text for text in texts)
    assert all(text.isprintable() for text in texts)


def test_a_watch_of_nothing_is_quick_and_tells_how_far_it_is() -> None:
    told: list[float] = []
    look(Namespace(), 0.1, told.append)
    assert told == sorted(told)
    assert told
    assert not [one for one in found(0.0) if one.area != "timing"]
