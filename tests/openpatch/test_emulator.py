"""The emulated patch: what it says, held against the protocol as the tests know it; and the driver on it."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest

from skinware import DriverReader
from skinware.cli._command import exit_status
from skinware.realtime import now_ns
from skinware_drivers.cli.emulate import command
from skinware_drivers.serial.bus import PtyBus, SerialBus
from skinware_drivers.serial.openpatch import OpenPatchDriver, OpenPatchOptions
from skinware_drivers.testing.driving import carried_on
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.devices.openpatch import EmulatedOpenPatch, EmulatedOpenPatchOptions, stuff, unstuff
from tests.openpatch import wire
from tests.sdk.driving import driving_lines, read_until, restarted_on_demand

MS = 1_000_000
SAID = wire.Said(
    product="emulated",
    serial_number="A",
    periods_us=(10_000, 1000, 1_000_000),
    types=[(1, 0.01, 0.0, 0.0, 655.35, "pressure", "kPa")],
    kinds=[("triangle", 2, [(12, [0])])],
    modules=[(0, 2)],
)


def emulated(**options: Any) -> EmulatedOpenPatch:
    return EmulatedOpenPatch(EmulatedOpenPatchOptions(modules=2, serial_number="A", **options))


class Talk:
    """A conversation with a patch whose time the test owns: (type, payload) of its messages."""

    def __init__(self, patch: EmulatedOpenPatch) -> None:
        self.patch = patch
        self.now_ns = 10**12
        self.framer = OpenPatchDriver.framing.framer()
        patch.skip(self.now_ns)

    def hear(self, duration_ms: int) -> list[tuple[int, bytes]]:
        self.now_ns += duration_ms * MS
        framed = self.framer.feed(b"".join(frame.payload for frame in self.patch.emit(self.now_ns)))
        assert self.framer.counters.skipped_bytes == self.framer.pending == 0
        return [(frame.identifier, frame.body) for frame in framed]

    def ask(self, request: int, *arguments: int) -> list[tuple[int, bytes]]:
        self.patch.receive(0, wire.frame(request, bytes((9, *arguments))), self.now_ns)
        return self.hear(1)


def test_it_speaks_the_protocol() -> None:
    items, talk = SAID.items(), Talk(emulated())
    crc = struct.pack("<I", wire.crc32(b"".join(items)))
    assert talk.hear(1500) == [(0x60, wire.greeting(items, reset=1, uptime_ms=ms)) for ms in (0, 1000)]
    assert talk.ask(1, 1, 0) == [(0x41, bytes((9, 0)) + wire.greeting(items, reset=1, uptime_ms=1500))]
    for number, item in enumerate(items):
        assert talk.ask(2, number, 0) == [(0x42, bytes((9, 0, number, 0)) + item)]
    assert talk.ask(2, len(items), 0) == [(0x42, bytes((9, 3)))]
    assert talk.hear(3000) == []
    assert talk.ask(3, 1, 2, 3, 4) == [(0x43, bytes((9, 8)))]
    assert talk.ask(5, 1, 0, 0, 0) == [(0x45, bytes((9, 4)))]
    assert talk.ask(5, 0x20, 0x4E, 0, 0) == [(0x45, bytes((9, 0, 0x20, 0x4E, 0, 0)))]
    assert talk.ask(6, 1, 0) == [(0x46, bytes((9, 0)))]
    assert talk.ask(7, 2) == [(0x47, bytes((9, 3)))]
    assert talk.ask(7) == [(0x47, bytes((9, 2)))]
    assert talk.ask(0x1F) == [(0x5F, bytes((9, 1)))]
    assert talk.ask(0x41, 0) == []
    masked = (0x80, struct.pack("<BHIB", 1, 0, 0, 32) + bytes(24))
    assert talk.ask(3, *crc)[:2] == [(0x43, bytes((9, 0))), masked]
    heard = [payload[:8] for message, payload in talk.hear(200) if message == 0x80]
    assert heard == [struct.pack("<BHIB", 0, n, 20_000 * n, 0) for n in range(len(heard))]
    assert len(heard) in (9, 10)
    assert talk.ask(4)[-1] == (0x44, bytes((9, 0)))
    assert talk.hear(500) == []


def test_its_bytes_are_those_of_the_protocol() -> None:
    patch, items = emulated(), SAID.items()
    patch.skip(10**12)
    request = wire.frame(1, b"\x09\x01\x00")
    patch.receive(0, b"\x05garbage" + request[:3], 10**12)
    patch.receive(0, request[3:] + b"\0" + request, 10**12)  # the first lies behind garbage that no zero ended
    answer = wire.frame(0x41, bytes((9, 0)) + wire.greeting(items, reset=1))
    said = b"".join(frame.payload for frame in patch.emit(10**12 + MS))
    assert said == wire.frame(0x60, wire.greeting(items, reset=1)) + answer
    assert patch.totals()["commands"] == 1


def test_stuffing() -> None:
    for pattern in (b"\1", b"\0", b"\1" * 254 + b"\0", b"\0" + b"\1" * 254):
        for n in (0, 1, 253, 254, 255, 508, 509):
            data = (pattern * n)[:n]
            assert stuff(data) == wire.stuff(data)
            assert unstuff(stuff(data)) == data


def test_what_was_never_stuffed_is_nothing() -> None:
    assert unstuff(b"\x05abc") == b""


def test_the_driver_reads_it_and_sets_it_up_again_after_a_restart(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    link = tmp_path / "port"
    devices = restarted_on_demand(EmulatedOpenPatch)
    options = EmulatedOpenPatchOptions(modules=2, serial_number="A", pattern="cycle", boot_s=0.1)
    with carried_on(PtyBus(str(link), payload_size=4096), devices(options)):
        driver = OpenPatchDriver(OpenPatchOptions(rate_hz=50))
        bus = SerialBus(str(link), payload_size=driver.payload_size)
        with driving_lines([(driver, bus)], "openpatch"), DriverReader("openpatch", timeout_s=30) as reader:
            before = read_until(reader, lambda f: not f.status.any())
            assert len(set(before.values.tolist())) == 1
            assert before.structure.patch_name.tolist() == [b"emulated A"]
            devices.restart_now = True
            wait_until(lambda: "emulated A has restarted" in caplog.text)
            since_ns = now_ns()
            read_until(reader, lambda f: bool((f.module_time_ns > since_ns).all()) and not f.status.any())
            assert reader.patch_counters(reader.read())[0]["sequence_lost"] == 0


def test_it_lives_on_serial_lines_and_has_its_line_for_itself(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("skinware_drivers.virtual.hardware.load_emulator", lambda name: EmulatedOpenPatch)
    for more, reason in (
        (["--bus", "vcan0"], "devices of openpatch are attached to a serial line; give pty:"),
        (["--bus", "pty", "--foreign-hz", "5"], "nothing else is attached to a serial line"),
    ):
        assert exit_status(command, ["--driver", "openpatch", *more]) == 2
        assert reason in capsys.readouterr().err
