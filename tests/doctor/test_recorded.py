"""``skin-doctor`` with recordings, from the file alone."""

from __future__ import annotations

import itertools
import json
import random
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import BusState, PatchState, Status
from skinware.errors import BadRecording
from skinware.realtime import NS_PER_S, now_ns
from skinware.recording import Recording
from skinware_drivers.doctor import recorded
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.recorded import look_at
from skinware_drivers.doctor.rules import Finding, Severity
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill
from tests.doctor.rig import nothing_found
from tests.recording.damaging import damaged, with_a_bad_chunk
from tests.recording.rig import has, publish, recording


def seen(file: Path) -> tuple[Evidence, dict[str, Finding]]:
    """The evidence, and the findings by what they say."""
    evidence = look_at(file)
    return evidence, {finding.what: finding for finding in examine(evidence).findings}


def record(file: Path, skin: FakeSkin, *parts: Any) -> None:
    """Record frames of a skin; each part changes something before its frames."""
    with skin, recording(file) as recorder:
        skin.publish()
        has(recorder, skin.writer.name)
        for part in (lambda: None, *parts):
            part()
            publish(skin, 25)


@pytest.mark.timeout(150)
def test_nothing_is_wrong_with_a_healthy_one(tmp_path: Path) -> None:
    files = (tmp_path / f"walk{number}.mcap" for number in itertools.count())
    kept: list[Evidence] = []

    def run_and_look() -> Sequence[Finding]:
        file = next(files)
        with emulated_skin("roboskin", name="torso", boards=(7, 8)) as skin, recording(file) as recorder:
            has(recorder, "torso")
            for _ in range(15):
                skin.reader.read(newer_than=skin.reader.newest_position)
        evidence, findings = seen(file)
        kept.append(evidence)
        return list(findings.values())

    nothing_found(run_and_look)
    evidence = kept[-1]
    (driver,) = evidence.drivers
    assert (driver.name, driver.life, driver.restarts) == ("torso", "live", 0)
    assert driver.frames >= 15
    assert driver.timing.rate_hz == pytest.approx(20, rel=0.5)
    told = examine(evidence)
    assert {one.what: one.seen for one in told.looked}["recorded by"] == "skinware 0.1.0"
    assert {one.what for one in told.not_looked} >= {"interfaces", "permissions"}


def test_losses_states_and_silent_patches_over_time(tmp_path: Path) -> None:
    skin = FakeSkin("torso")
    skin.status[40] = Status.NO_ACK

    def lose() -> None:
        skin.bus_counters[0] += np.array([100, 7, 0, 0], np.uint64)
        skin.patch_counters[1] += np.array([90, 640], np.uint64)
        skin.bus_state[0], skin.patch_state[3] = BusState.GONE, PatchState.STALE

    def come_back() -> None:
        skin.bus_state[0], skin.patch_state[3] = BusState.LIVE, PatchState.LIVE
        skin.patch_state[2] = PatchState.STALE
        skin.patch_counters[1, 0] -= 2  # as if frames that were taken for lost had come late

    file = tmp_path / "walk.mcap"
    record(file, skin, lose, come_back)
    evidence, findings = seen(file)
    assert findings["board 9 fell silent"].severity == Severity.ERROR
    assert findings["board 10 fell silent and came back"].severity == Severity.WARNING
    assert findings["it was away, and came back"].evidence.startswith("gone from ")
    lost = findings["frames were dropped before the driver took them"]
    assert lost.evidence.startswith("7 frames in ")
    assert findings["frames came without their partners, whose update was not shown"].evidence.startswith(
        "board 8: 88 frames"
    )
    assert "1 sensor does not answer the microcontroller" in findings
    assert [change.state for change in evidence.drivers[0].buses[0].changes] == ["live", "gone", "live"]
    assert not any(command.startswith("skin-info") for finding in findings.values() for command in finding.commands)


def test_restarts_with_the_same_and_with_other_sensors(tmp_path: Path) -> None:
    file = tmp_path / "walk.mcap"
    with recording(file) as recorder:
        for number, structure in enumerate((fake_structure(2), fake_structure(2), fake_structure(3))):
            with FakeSkin("torso", structure) as skin:
                skin.publish()
                has(recorder, "torso")
                publish(skin, 10)
                skin.patch_counters[0] = (100 * (number + 1), 10)
                publish(skin, 20)
    evidence, findings = seen(file)
    (driver,) = evidence.drivers
    assert (driver.restarts, driver.structure.n_patches) == (2, 3)
    assert findings["the driver was restarted"].evidence == "2 times"
    assert driver.patches[0].counted.grown["orphans"] == 600  # of all three, under the one name
    assert len(driver.patches) == 3


@pytest.mark.thorough
def test_a_driver_that_died_while_it_was_recorded(tmp_path: Path) -> None:
    file = tmp_path / "walk.mcap"
    with fake_process("torso") as process, recording(file) as recorder:
        has(recorder, "torso")
        kill(process)
        wait_until(lambda: recorder.messages.get("/skin/events", 0) >= 2)
    _, findings = seen(file)
    assert findings["the driver was killed"].severity == Severity.ERROR


@pytest.mark.thorough
def test_one_that_was_cut_or_damaged(tmp_path: Path) -> None:
    file = tmp_path / "walk.mcap"
    record(file, FakeSkin("torso"), *[lambda: None] * 8)
    data = file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[:-400])
    _, findings = seen(cut)
    assert findings["the recording was cut off"].commands == ("skin-recover cut.mcap",)
    cut.write_bytes(with_a_bad_chunk(file)[:-400])
    _, findings = seen(cut)
    assert "1 chunk damaged and left out" in findings["the recording is damaged"].evidence


@pytest.mark.thorough
def test_no_damage_is_too_much(tmp_path: Path) -> None:
    """Hostile files: each is examined or refused with one line."""
    file = tmp_path / "walk.mcap"
    record(file, FakeSkin("torso", fake_structure(1, 2)), lambda: None)
    data, generator, examined = file.read_bytes(), random.Random(5), 0
    for _ in range(60):
        file.write_bytes(damaged(data, generator)[0])
        try:
            evidence = look_at(file)
        except BadRecording:
            continue
        examined += 1
        assert examine(evidence).looked
    assert examined > 20


def test_clocks_that_were_set_and_events_that_are_nonsense(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "walk.mcap"
    record(file, FakeSkin("torso"))
    clock = [
        {"time_s": 0.0, "monotonic_ns": 0, "realtime_ns": 0, "boot": "a"},
        {"time_s": 1.0, "monotonic_ns": NS_PER_S, "realtime_ns": 61 * NS_PER_S, "boot": "a"},
        {"time_s": 2.0, "monotonic_ns": "soon", "boot": ["b"]},
        {"time_s": 3.0},
    ]
    events = [
        {"event": "missed", "service": "torso", "count": 3, "time_s": 0.0},
        {"event": "missed", "service": ["torso"], "count": "many", "time_s": 0.0},
        {"event": {"a": 1}, "time_s": 1.0},
        {"event": "unreadable", "service": "leg", "time_s": 1.0},
        {"time_s": 1.0},
    ]
    monkeypatch.setattr(Recording, "clock", property(lambda _: json.loads(json.dumps(clock))))
    monkeypatch.setattr(Recording, "events", property(lambda _: json.loads(json.dumps(events))))
    _, findings = seen(file)
    assert findings["the wall clock was set, or the machine slept"].evidence == "by +60.00 s"
    assert findings["the recorder missed samples"].evidence.startswith("3 samples ")
    assert "a service could not be recorded" in findings


@pytest.mark.thorough
def test_taxels_that_are_noisy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the file alone: one taxel of a quiet skin is noisy for 25 s, recorded in one."""
    monkeypatch.setattr(recorded, "_LOOK_EVERY_NS", 0)
    file = tmp_path / "walk.mcap"
    skin = FakeSkin("torso", fake_structure(1, 4))
    generator = np.random.default_rng(1)
    with skin, recording(file) as recorder:
        skin.publish()
        has(recorder, "torso")
        begun_ns = now_ns()
        for number in range(500):
            columns = skin.writer.begin(from_last=True)
            columns["values"][:] = 240 + generator.integers(0, 2, skin.structure.n_sensors)
            columns["values"][7] = 225 + generator.integers(0, 30)
            columns["module_time_ns"][:] = time_ns = begun_ns + number * 50_000_000
            skin.writer.commit(time_ns)
            time.sleep(0.003)
    (driver,) = look_at(file).drivers
    assert driver.frames == 501
    health = driver.health
    assert health is not None
    assert [(fault.name, fault.kind) for fault in health.faults] == [("board 7, triangle 0, taxel 7", "noisy")]
    _, findings = seen(file)
    assert "times that of the others" in findings["1 taxel is noisy"].evidence
