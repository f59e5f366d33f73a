"""``skin-emulate``: pacing, trouble with the bus, and the command around it."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skinware.cli._command import exit_status
from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware_drivers import registry
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.cli.emulate import SignalWatch, command, report_to
from skinware_drivers.options import describe_options
from skinware_drivers.virtual.emulation import Emulation, wait_readable
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions
from tests.commands import BIN

from .rig import MS, START_NS

SECOND_NS = 1000 * MS


class HostBus(Bus):
    """What a host would see: every frame sent, with its moment; and knobs for trouble."""

    def __init__(self, channel: str = "host", options: dict[str, str] | None = None, **keywords: Any) -> None:
        super().__init__(channel, options, **keywords)
        self.time_ns = START_NS
        self.opened = 0
        self.is_open = False
        self.up = True
        self.room: int | None = None
        self.from_host: deque[tuple[int, bytes]] = deque()
        self.sent_frames: list[tuple[int, int, bytes]] = []

    def open(self) -> None:
        if not self.up:
            raise BusNotAvailable("host: down")
        self.opened += 1
        self.is_open = True

    def fileno(self) -> int:
        return 99

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        if not self.up:
            raise BusNotAvailable("host: went down")
        count = 0
        while self.from_host and batch.free:
            batch.append(ordinal, self.time_ns, *self.from_host.popleft())
            count += 1
        return count

    def send(self, identifier: int, payload: bytes) -> None:
        if self.room is not None:
            if not self.room:
                raise BusSendError("queue full")
            self.room -= 1
        self.sent_frames.append((self.time_ns, identifier, payload))

    def close(self) -> None:
        self.is_open = False


class Script:
    """Stands for the clock and for waiting: at given moments something is done to the bus."""

    def __init__(self, bus: HostBus) -> None:
        self.bus = bus
        self.stopped = False
        self.waits_s: list[float] = []
        self.descriptors: list[list[int]] = []
        self.actions: dict[int, Any] = {}

    def fileno(self) -> int:
        return 98

    def clock(self) -> int:
        return self.bus.time_ns

    def at_ms(self, time_ms: int, action: Any) -> None:
        self.actions[START_NS + time_ms * MS] = action

    def poll(self, descriptors: list[int], timeout_s: float | None) -> None:
        assert timeout_s is not None
        self.waits_s.append(timeout_s)
        self.descriptors.append(descriptors)
        until_ns = self.bus.time_ns + max(1, -(-round(timeout_s * 1e9) // MS)) * MS  # as epoll rounds
        due = [moment for moment in self.actions if moment <= until_ns]
        if due:
            until_ns = max(self.bus.time_ns, min(due))
            self.actions.pop(min(due))()
        self.bus.time_ns = max(self.bus.time_ns, until_ns)


class Run:
    def __init__(self, **options: Any) -> None:
        self.bus = HostBus()
        self.script = Script(self.bus)
        self.options = EmulatedRoboskinOptions(**{"boards": (7,), **options})
        self.hardware = EmulatedRoboskin(self.options)
        self.output = io.StringIO()

    def __call__(self, duration_s: float | None) -> Emulation:
        report, script = report_to(self.output, as_json=True), self.script
        emulation = Emulation(self.bus, self.hardware, report, clock=script.clock, poll=script.poll)
        emulation.run(self.script, bus_name="host", driver="roboskin", options=self.options, duration_s=duration_s)
        return emulation

    @property
    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.output.getvalue().splitlines()]

    def heads_ms(self) -> list[float]:
        return [(time_ns - START_NS) / MS for time_ns, identifier, _ in self.bus.sent_frames if identifier == 0x470]


def test_frames_go_out_when_they_are_due_and_none_is_missing() -> None:
    run = Run(streaming=True, pattern="cycle")
    reference = EmulatedRoboskin(run.options)
    reference.skip(START_NS)
    run(5)
    expected = reference.emit(START_NS + 5 * SECOND_NS)
    sent = run.bus.sent_frames
    assert len(expected) - 10 <= len(sent) <= len(expected)
    for (time_ns, identifier, payload), frame in zip(sent, expected, strict=False):
        assert (identifier, payload) == (frame.identifier, frame.payload)
        assert 0 <= time_ns - frame.time_ns <= MS
    assert len(run.script.waits_s) < 5 * 20 * 7  # several frames a wake-up


def test_it_sleeps_while_nothing_is_due() -> None:
    run = Run()
    run(10)
    assert len(run.script.waits_s) < 25


def test_what_the_host_says_reaches_the_boards() -> None:
    run = Run()
    run.bus.from_host.extend([(0x207, bytes.fromhex("1C0200")), (0x207, bytes.fromhex("0700"))])
    run.script.at_ms(1000, lambda: run.bus.from_host.append((0x207, bytes.fromhex("0701"))))
    run(3)
    assert run.bus.sent_frames[0][1:] == (0x270, bytes.fromhex("1C0B011900020001"))
    assert len(run.heads_ms()) == 2 * 20
    assert max(run.heads_ms()) < 1010
    assert run.lines[-1]["commands"] == 3


def test_more_from_the_host_than_one_batch_holds() -> None:
    run = Run()
    run.bus.from_host.extend([(0x207, bytes.fromhex("1C0200"))] * 600)
    run(1)
    assert run.lines[-1]["commands"] == 600


def test_status_lines() -> None:
    run = Run(streaming=True)
    run(3.5)
    assert [line["event"] for line in run.lines] == ["ready", "status", "status", "status", "stopped"]
    assert run.lines[0]["options"]["boards"] == [7]
    assert (run.lines[0]["bus"], run.lines[0]["driver"]) == ("host", "roboskin")
    assert [line["bursts"] for line in run.lines[1:4]] == [20, 40, 60]
    assert run.lines[-1]["frames"] == len(run.bus.sent_frames)
    assert {"frames", "bursts", "commands", "send_failures"} <= set(run.lines[1])
    assert not run.bus.is_open


def test_a_full_queue_delays_frames_and_loses_none() -> None:
    run = Run(streaming=True, pattern="cycle")

    def full() -> None:
        run.bus.room = 3

    def free() -> None:
        run.bus.room = None

    run.script.at_ms(1000, full)
    run.script.at_ms(1300, free)
    emulation = run(3)
    assert emulation.send_failures == 0
    assert run.lines[-1]["frames"] == len(run.bus.sent_frames)
    sent = [(identifier, payload) for _, identifier, payload in run.bus.sent_frames]
    reference = EmulatedRoboskin(run.options)
    reference.skip(START_NS)
    expected = [(frame.identifier, frame.payload) for frame in reference.emit(START_NS + 3 * SECOND_NS)]
    assert sent == expected[: len(sent)]


def test_a_queue_that_stays_full_costs_frames_which_are_counted() -> None:
    run = Run(streaming=True)
    run.script.at_ms(1000, lambda: setattr(run.bus, "room", 0))
    emulation = run(3)
    stuck = 40 * 32 - 16 * 32
    assert stuck <= emulation.send_failures <= stuck + 10 * 32
    assert run.lines[-1]["send_failures"] == emulation.send_failures
    assert len(run.script.waits_s) < 2 * 20 * 8 + 2000 / 2 + 100  # retries pause


def test_a_bus_that_goes_down_is_reported_once_and_opened_again() -> None:
    run = Run(streaming=True, pattern="cycle")

    def change(up: bool) -> None:
        run.bus.up = up

    run.script.at_ms(1000, lambda: change(False))
    run.script.at_ms(11_000, lambda: change(True))
    run(20)
    kinds = [line["event"] for line in run.lines if line["event"] != "status"]
    assert kinds == ["ready", "bus_down", "bus_up", "stopped"]
    assert "went down" in run.lines[kinds.index("bus_down") + 1]["reason"]
    assert run.bus.opened == 2
    heads = run.heads_ms()
    assert not [moment for moment in heads if 1001 < moment < 11_000]
    assert min(moment for moment in heads if moment > 1001) < 13_100
    totals = run.lines[-1]
    assert totals["unheard"] > 9 * 20 * 32
    assert (totals["bursts"] - 1) * 32 <= totals["frames"] + totals["unheard"] <= totals["bursts"] * 32
    last = [payload[1] for _, identifier, payload in run.bus.sent_frames if identifier == 0x470]
    assert last[-1] > 128  # cycles went on


def test_attempts_to_open_again_come_slower_and_slower() -> None:
    run = Run()
    run.script.at_ms(500, lambda: setattr(run.bus, "up", False))
    run(60)
    assert 30 < sum(descriptors == [98] for descriptors in run.script.descriptors) < 100
    assert run.bus.opened == 1


def test_a_bus_that_cannot_be_opened_at_first_is_an_error() -> None:
    run = Run()
    run.bus.up = False
    with pytest.raises(BusNotAvailable):
        run(1)


def test_a_process_that_was_stopped_does_not_send_everything_it_missed() -> None:
    run = Run(streaming=True)

    def sleep() -> None:
        run.bus.time_ns += 3600 * SECOND_NS

    run.script.at_ms(1000, sleep)
    run.script.at_ms(3_602_000, lambda: setattr(run.script, "stopped", True))
    run(None)
    assert len(run.bus.sent_frames) < 4 * 20 * 32
    assert run.lines[-1]["unheard"] > 3598 * 20 * 32


def test_being_stopped_ends_the_run() -> None:
    run = Run(streaming=True)
    run.script.at_ms(700, lambda: setattr(run.script, "stopped", True))
    run(None)
    assert run.lines[-1]["event"] == "stopped"
    assert run.bus.time_ns < START_NS + 800 * MS


def test_lines_for_a_person() -> None:
    stream = io.StringIO()
    report = report_to(stream, as_json=False)
    report("ready", driver="roboskin", bus="vcan0", options={})
    report("status", frames=1)
    report("bus_down", reason="no cable")
    report("bus_up")
    report("stopped", frames=2, bursts=1)
    assert stream.getvalue().splitlines() == [
        "emulating roboskin on vcan0; Ctrl-C stops",
        "bus down: no cable",
        "bus up",
        "stopped: frames 2, bursts 1",
    ]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_wake_the_wait_and_handlers_are_put_back(number: signal.Signals) -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with SignalWatch() as watch:
        os.kill(os.getpid(), number)
        wait_readable([watch.fileno()], 10)
        assert watch.stopped
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before


# The command


@pytest.fixture
def host_buses(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[HostBus]]:
    made: list[HostBus] = []

    def make_bus(name: str, *, payload_size: int = 8, listen_only: bool = False, for_devices: bool = False) -> Bus:
        if name == "nonsense":
            raise ConfigurationError("no such bus")
        bus = HostBus(name, payload_size=payload_size, listen_only=listen_only)
        bus.up = name != "down"
        bus.time_ns = 0
        bus.fileno = lambda: pipe[0]  # type: ignore[method-assign]
        made.append(bus)
        return bus

    pipe = os.pipe()
    monkeypatch.setattr(registry, "make_bus", make_bus)
    yield made
    for end in pipe:
        os.close(end)


def test_help_shows_every_option_of_the_emulator(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, ["--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for option in describe_options(EmulatedRoboskinOptions):
        assert f"--{option.name.replace('_', '-')}" in text
    assert "CAN addresses of the boards, 1-14. [default: 7,8,9,10]" in text


def test_options_of_the_command_line_reach_the_emulator(
    host_buses: list[HostBus], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.jsonl"
    faults = ["--boards", "7-8", "--lose", "1", "--streaming", "--log", str(log)]
    assert exit_status(command, ["--bus", "host", *faults, "--json", "-T", "0.2"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[0]["options"]["boards"] == [7, 8]
    assert lines[0]["options"]["lose"] == 1.0
    assert lines[0]["options"]["streaming"] is True
    assert lines[-1]["lost"] == log.read_text().count('"fault":"lost"') > 32
    assert host_buses[0].sent_frames == []
    assert not host_buses[0].is_open


def test_a_run_without_options_is_silent_and_ends_well(
    host_buses: list[HostBus], capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_status(command, ["--bus", "host", "-T", "0"]) == 0
    assert capsys.readouterr().out.startswith("emulating roboskin on host")
    assert host_buses[0].payload_size == 8


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ((), 2, "Missing option '--bus'"),
        (("--bus", "host", "--boards", "15"), 2, "address 15 is outside 1-14"),
        (("--bus", "host", "--boards", "x"), 2, "option boards=x"),
        (("--bus", "host", "--bords", "7"), 2, "--boards"),
        (("--bus", "nonsense"), 2, "no such bus"),
        (("--bus", "down"), 1, "host: down"),
        (("--bus", "host", "--driver", "robskin"), 2, "did you mean 'roboskin'"),
        (("--bus", "host", "--driver=robskin"), 2, "did you mean 'roboskin'"),
        (("--bus", "host", "--log", "/nonexistent/x", "-T", "0"), 2, "cannot write the log"),
    ],
)
@pytest.mark.usefixtures("host_buses")
def test_exit_status(arguments: tuple[str, ...], status: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, arguments) == status
    assert message in capsys.readouterr().err


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_command_with_status_0(number: signal.Signals, tmp_path: Path) -> None:
    """The whole command in a process of its own, on a bus that needs no kernel support."""
    log = tmp_path / "log.jsonl"
    arguments = ["--driver", "anyskin", "--bus", "pty", "--json", "--log", str(log)]
    with subprocess.Popen([BIN / "skin-emulate", *arguments], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["event"] == "ready"
        process.send_signal(number)
        rest = process.stdout.read().splitlines()
        assert process.wait(20) == 0
    assert json.loads(rest[-1])["event"] == "stopped"
