"""What emulators of small devices have in common: touch, time, commands, and faults that are logged exactly."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.devices.xela import EmulatedXela, EmulatedXelaOptions
from skinware_drivers.virtual.hardware import Event, WireFrame, load_emulator

from .rig import MS, START_NS

TAXELS = 16


class Rig:
    """Emulated boards whose time the test owns."""

    def __init__(self, **options: Any) -> None:
        self.log: list[Event] = []
        self.hardware = EmulatedXela(EmulatedXelaOptions(**options), log=self.log)
        self.now_ns = START_NS
        self.hardware.skip(START_NS)

    def run_ms(self, duration_ms: float) -> list[WireFrame]:
        self.now_ns += round(duration_ms * MS)
        return self.hardware.emit(self.now_ns)

    def send(self, identifier: int, payload: str) -> None:
        self.hardware.receive(identifier, bytes.fromhex(payload), self.now_ns)

    def faults(self, kind: str) -> list[Event]:
        return [e for e in self.log if e.event == "frame_fault" and e.fault == kind]


def pressures(frames: Sequence[WireFrame]) -> list[int]:
    return [int.from_bytes(frame.payload[5:7], "big") for frame in frames]


def test_a_board_is_silent_until_started_and_after_it_was_stopped() -> None:
    rig = Rig()
    assert rig.run_ms(100) == []
    rig.send(0x201, "0700")
    assert len(rig.run_ms(100)) >= 9 * TAXELS
    rig.send(0x202, "0701")  # another board
    assert rig.run_ms(100)
    rig.send(0x201, "0701")
    rig.run_ms(5)  # what was on its way
    assert rig.run_ms(100) == []
    told = [(e.identifier, e.payload, e.boards) for e in rig.log if e.event == "command_received"]
    assert told == [(0x201, "0700", [1]), (0x201, "0701", [1])]
    assert rig.hardware.totals()["commands"] == 2


def test_bursts_keep_their_period_for_ever() -> None:
    rig = Rig(streaming=True, period_ms=20)
    starts = [frame.time_ns for frame in rig.run_ms(2000) if frame.identifier == 0x710]
    assert {b - a for a, b in pairwise(starts)} == {20 * MS}
    assert rig.hardware.totals()["bursts"] == len(starts)


@pytest.mark.thorough
def test_a_press_comes_and_goes_and_an_idle_board_rests() -> None:
    felt = pressures(Rig(streaming=True).run_ms(8000))
    assert min(felt) == EmulatedXela.rest
    assert max(felt) > EmulatedXela.rest + EmulatedXela.swing // 2
    assert set(pressures(Rig(streaming=True, pattern="idle").run_ms(1000))) == {EmulatedXela.rest}
    assert felt == pressures(Rig(streaming=True).run_ms(8000))
    assert felt != pressures(Rig(streaming=True, seed=1).run_ms(8000))


def test_the_pattern_cycle_numbers_the_bursts() -> None:
    counted = Counter(pressures(Rig(streaming=True, pattern="cycle", period_ms=10).run_ms(1000)))
    assert all(counted[cycle] == TAXELS for cycle in range(95))


def test_every_fault_of_a_frame_is_logged_exactly() -> None:
    chances = {"lose": 0.1, "truncate": 0.1, "corrupt": 0.1, "repeat": 0.1}
    rig = Rig(streaming=True, pattern="cycle", **chances)
    frames = rig.run_ms(3000)
    rig.send(0x201, "0701")
    frames += rig.run_ms(50)
    totals = rig.hardware.totals()
    lost, truncated, corrupted, repeated = map(rig.faults, ("lost", "truncated", "corrupted", "repeated"))
    assert all(len(found) > 100 for found in (lost, truncated, corrupted, repeated))
    for name, found in (("lost", lost), ("truncated", truncated), ("corrupted", corrupted), ("repeated", repeated)):
        assert totals[name] == len(found)
    assert len(frames) == totals["frames"] == totals["bursts"] * TAXELS - len(lost) + len(repeated)
    # frame by frame: what was heard is what the log says
    heard = Counter((frame.identifier, frame.payload.hex()) for frame in frames)
    expected = Counter(
        (0x710 + taxel, f"00{cycle:04x}{cycle:04x}{cycle:04x}00")
        for cycle in range(totals["bursts"])
        for taxel in range(TAXELS)
    )
    for event in [*lost, *truncated, *corrupted, *repeated]:
        assert event.identifier == 0x710 + event.position
        whole = (event.identifier, f"00{event.cycle:04x}{event.cycle:04x}{event.cycle:04x}00")
        expected[whole] += 1 if event.fault == "repeated" else -1
        if event.fault in ("truncated", "corrupted"):
            expected[event.identifier, event.payload or ""] += 1
    assert heard == +expected
    assert {len(e.payload or "") // 2 for e in truncated} == set(range(8))


def test_a_late_burst_is_logged_and_the_next_one_is_on_time() -> None:
    plain, late = Rig(streaming=True), Rig(streaming=True, jitter_us=3000)
    expected = [frame.time_ns for frame in plain.run_ms(1000) if frame.identifier == 0x710]
    starts = [frame.time_ns for frame in late.run_ms(1000) if frame.identifier == 0x710]
    delays = {e.cycle: e.delay_ns for e in late.log if e.event == "burst_delayed"}
    assert len(delays) > 50
    assert [b - a for a, b in zip(expected, starts, strict=False)] == [delays.get(c, 0) for c in range(len(starts))]


def test_foreign_frames_are_none_of_the_devices_own_and_logged() -> None:
    rig = Rig(foreign_hz=500)
    frames = rig.run_ms(2000)
    assert len(frames) > 800
    logged = [(e.identifier, e.length) for e in rig.log if e.event == "foreign_frame"][: len(frames)]
    assert sorted((f.identifier, len(f.payload)) for f in frames) == sorted(logged)
    assert not {f.identifier for f in frames} & set(rig.hardware.identifiers)
    assert any(f.identifier & 0x8000_0000 for f in frames)


def test_a_device_that_dies_is_silent_and_deaf_and_what_it_had_to_send_is_lost() -> None:
    rig = Rig(streaming=True, dead=(1,), dead_after_s=0.5)
    frames = rig.run_ms(1000)
    rig.send(0x201, "0700")
    assert rig.run_ms(100) == []
    (died,) = (e for e in rig.log if e.event == "board_died")
    assert died.time_ns == START_NS + 500 * MS
    assert max(frame.time_ns for frame in frames) < died.time_ns
    assert len(frames) == rig.hardware.totals()["bursts"] * TAXELS - len(rig.faults("unsent"))


def test_a_restarted_device_has_forgotten_what_it_was_told() -> None:
    rig = Rig(restart=(1,), restart_after_s=0.5, boot_s=0.1)
    rig.send(0x201, "0700")
    assert rig.run_ms(490)
    rig.run_ms(60)
    rig.send(0x201, "0700")  # it does not hear that yet
    assert rig.run_ms(100) == []
    (event,) = (e for e in rig.log if e.event == "board_restarted")
    assert (event.time_ns, event.ready_ns) == (START_NS + 500 * MS, START_NS + 600 * MS)
    rig.send(0x201, "0700")
    assert rig.run_ms(100)


def test_a_dead_device_lives_again_once_it_has_power() -> None:
    rig = Rig(streaming=True, boot_s=0.1)
    rig.run_ms(100)
    rig.hardware.kill(1, rig.now_ns)
    assert rig.run_ms(200) == []
    rig.hardware.restart(1, rig.now_ns)
    assert rig.run_ms(95) == []
    assert rig.run_ms(50)


def test_time_that_nobody_listened_is_skipped_and_counted() -> None:
    rig = Rig(streaming=True, period_ms=10)
    rig.now_ns += 3600 * 1000 * MS
    assert rig.hardware.skip(rig.now_ns) > 360_000 - 200
    assert rig.hardware.totals()["bursts"] == pytest.approx(360_000, abs=2)
    assert rig.run_ms(20)


def test_a_queue_that_runs_over_is_logged() -> None:
    rig = Rig(streaming=True, boards=(1, 2, 3, 4, 5, 6, 7), model="4x6", period_ms=10)  # 22 ms of frames each 10 ms
    rig.run_ms(1000)
    assert rig.faults("unsent")
    assert rig.hardware.totals()["lost"] == len(rig.faults("unsent"))


def test_devices_that_are_not_there_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="option dead: there is no device 2; there are 1"):
        Rig(dead=(2,))
    with pytest.raises(ConfigurationError, match="option lose=2"):
        Rig(lose=2)


@pytest.mark.parametrize("name", ["allegro_v5", "barrett", "canopen", "cyskin_cpm", "linkerhand", "roboskin", "xela"])
def test_every_driver_has_an_emulator_of_its_name(name: str) -> None:
    emulator = load_emulator(name)
    emulator(emulator.Options()).skip(START_NS)
