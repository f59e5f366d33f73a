"""Health beside a calmed driver."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import DriverReader, Namespace, ServiceReader, ServiceWriter, Status
from skinware.errors import BadServiceFile
from skinware.sensor_types import SHEAR_X, TEMPERATURE
from skinware.tactile.chain import Chain, ChainSettings
from skinware.tactile.chain_state import LearnedState, save_state
from skinware.tactile.contacts_service import ContactsReader
from skinware.tactile.derived_services import CalmHealth
from skinware.tactile.health import COLUMNS, NOTHING, HealthKind, HealthReport
from skinware.tactile.health_service import HealthReader, HealthWriter
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.tactile.test_calm_contacts import calming, press

AT_END, RUSTLING = 12, 40
"""Positions in a frame of pressure sensors."""
SETTLED_NS, PERIOD_NS = 30_000_000_000, 50_000_000


@pytest.fixture
def into(calm_namespace: Namespace) -> Namespace:
    return calm_namespace


class Calmed:
    """A fake skin whose frames go through a chain and past its health, in a time of their own."""

    def __init__(self, skin: FakeSkin, reader: DriverReader, health: CalmHealth) -> None:
        self.skin, self.health, self._reader = skin, health, reader
        self.chain: Chain = ChainSettings.calm().chain(skin.structure)
        self.status = np.zeros(skin.structure.n_sensors, np.uint8)
        self._values = np.zeros(skin.structure.n_sensors, np.float32)
        self._random, self._time_ns = np.random.default_rng(1), 0
        health.follow(self.chain)

    def go_on(self, for_ns: int) -> None:
        assert self.skin.values is not None
        rest = self.skin.values.copy()
        for _ in range(for_ns // PERIOD_NS):
            self.skin.values = rest + self._random.integers(0, 2, len(rest))
            self.skin.values[RUSTLING] += self._random.integers(-20, 20)
            self.skin.values[AT_END] = rest[AT_END]
            self._time_ns += PERIOD_NS
            self.skin.acquired_ns = self._time_ns
            self.skin.publish()
            self.chain.step(self._reader.read(), self._values, self.status)
            self.health.update(self._time_ns)
            self.health.mark(self.status)
        self.skin.values = rest


@contextmanager
def calmed(into: Namespace, name: str = "health") -> Iterator[Calmed]:
    health = CalmHealth(name, "fake", into)
    with FakeSkin() as skin, DriverReader("fake") as reader:
        skin.values = np.full(skin.structure.n_sensors, 200.0)
        skin.values[AT_END] = 0  # of 255, which falls with pressure
        try:
            yield Calmed(skin, reader, health)
        finally:
            health.close()


@pytest.mark.thorough
def test_faults_are_published_and_marked(into: Namespace) -> None:
    with calmed(into) as skin, HealthReader(namespace=into) as reader:
        assert (reader.source.driver, len(reader.source.uid)) == ("fake", 768)
        skin.go_on(SETTLED_NS)
        report = reader.read().report
        assert np.flatnonzero(report.faulty).tolist() == [AT_END, RUSTLING]
        assert report.kind[[AT_END, RUSTLING]].tolist() == [HealthKind.CLIPPED, HealthKind.NOISY]
        assert report.evidence(AT_END, "counts") == "at 255 counts, an end of the range, for 100 % of the time"
        assert np.flatnonzero(skin.status & Status.UNHEALTHY).tolist() == [AT_END, RUSTLING]
        assert skin.health.faulty == 2
        temperatures = skin.chain.structure.index("temperature")
        assert np.isnan(report.still_s[temperatures]).all(), "they have no rest"
        assert (report.kind[temperatures] == HealthKind.GOOD).all()


@pytest.mark.thorough
def test_another_skin_begins_anew(into: Namespace) -> None:
    with calmed(into) as skin, HealthReader(namespace=into) as reader:
        skin.go_on(SETTLED_NS)
        assert reader.read().report.faulty.any()
        skin.health.follow(ChainSettings.calm().chain(fake_structure(1, 2)))
        assert skin.health.faulty == 0
        reader.reattach()
        assert len(reader.source.uid) == 24


@pytest.mark.thorough
@pytest.mark.parametrize("age_s", [0, 100_000])
def test_what_is_known_is_there_after_a_restart(into: Namespace, tmp_path: Path, age_s: int) -> None:
    """Baselines are worth nothing after 10 minutes; what is broken is broken on the next day."""
    path = tmp_path / "fake.npz"
    with calmed(into) as skin, HealthReader(namespace=into) as reader:
        skin.go_on(SETTLED_NS)
        before = reader.read().report
        LearnedState(path).close(skin.chain)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, allow_pickle=False, **arrays | {"time_s": arrays["time_s"] - age_s})
    with calmed(into) as skin, HealthReader(namespace=into) as reader:
        assert LearnedState(path).restore(skin.chain) == (0 if age_s else 640)
        skin.go_on(PERIOD_NS)
        report = reader.read().report
        assert report.kind[[AT_END, RUSTLING]].tolist() == [HealthKind.CLIPPED, HealthKind.NOISY]
        assert np.flatnonzero(skin.status & Status.UNHEALTHY).tolist() == [AT_END, RUSTLING]
        np.testing.assert_array_equal(report.noise, before.noise)


@pytest.mark.thorough
@pytest.mark.parametrize("damage", ["missing", "shape", "of another scale"])
def test_health_that_does_not_fit_is_begun_anew(
    into: Namespace, tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "fake.npz"
    with calmed(into) as skin:
        skin.go_on(SETTLED_NS)
        state = skin.chain.state()
        if damage == "missing":
            del state.arrays["health/pressure/noise"]
        elif damage == "shape":
            state.arrays["health/pressure/noise"] = np.zeros((640, 2), np.float32)
        save_state(path, replace(state, fingerprint="another") if damage == "of another scale" else state)
    with calmed(into) as skin:
        LearnedState(path).restore(skin.chain)
        skin.go_on(PERIOD_NS)
        assert skin.health.faulty == 0
    assert ("the learned state does not fit" in caplog.text) == (damage != "of another scale")


def test_without_sensors_that_a_touch_only_raises_there_is_none(into: Namespace) -> None:
    structure = fake_structure(1, 2)
    ids = np.array([TEMPERATURE.id, SHEAR_X.id], np.uint32)
    other = structure.replace(types=(TEMPERATURE, SHEAR_X), sensor_type=ids[np.arange(structure.n_sensors) % 2])
    health = CalmHealth("health", "fake", into)
    health.follow(ChainSettings.calm().chain(structure))
    assert (health.name, into.services()) == ("health", ["health"])
    health.follow(ChainSettings.calm().chain(other))
    status = np.zeros(other.n_sensors, np.uint8)
    health.update(10**10)
    health.mark(status)
    assert not status.any()
    assert (health.name, into.services()) == ("", [])
    health.follow(ChainSettings.calm().chain(structure))
    assert health.name == "health"
    health.close()


@pytest.mark.thorough
def test_a_name_that_another_program_has_costs_only_the_service(
    into: Namespace, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        HealthWriter(fake_structure(), "other", namespace=into),
        HealthWriter(fake_structure(), "other", name="fake-health", namespace=into),
        calmed(into) as skin,
    ):
        assert "no health of 'fake': " in caplog.text
        assert skin.health.name == ""
        skin.go_on(SETTLED_NS)
        assert np.flatnonzero(skin.status & Status.UNHEALTHY).tolist() == [AT_END, RUSTLING]


def test_skin_calm_publishes_it_beside_the_driver_if_wanted(into: Namespace, caplog: pytest.LogCaptureFixture) -> None:
    skin = FakeSkin("fake")
    press(skin)
    with skin, caplog.at_level(logging.WARNING):
        skin.publish(5)
        with calming_while(skin, into, health="fake_health") as names:
            assert names == ["contacts", "fake", "fake_health"]
        with calming_while(skin, into, health=None) as names:
            assert names == ["contacts", "fake"]
    assert caplog.text == ""


@contextmanager
def calming_while(skin: FakeSkin, into: Namespace, health: str | None) -> Iterator[list[str]]:
    """What is published while a skin is calmed."""
    import threading

    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.01):
            skin.publish()

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        with calming(into, health=health) as service:
            assert service.status()["faulty"] == 0
            yield sorted(into.services())
    finally:
        stop.set()
        thread.join()


def test_services_of_another_kind_or_form_are_refused(into: Namespace) -> None:
    n = 3
    static: dict[str, npt.NDArray[Any]] = {
        "sensor_uid": np.arange(n, dtype=np.uint64),
        "sensor_type": np.zeros(n, np.uint32),
        "driver": np.array([b"fake"], "S64"),
    }
    columns = {name: (dtype, (n,)) for name, (dtype, *_) in COLUMNS.items()}
    with (
        HealthWriter(fake_structure(), "fake", namespace=into),
        pytest.raises(BadServiceFile, match="not of kind 'contacts'"),
    ):
        ContactsReader("health", namespace=into)
    for wrong in (
        {"columns": columns, "static": static, "kind": "data"},
        {"columns": columns | {"noise": ("<f8", (n,))}, "static": static},
        {"columns": columns | {"noise": ("<f4", (n + 1,))}, "static": static},
        {"columns": {name: column for name, column in columns.items() if name != "kind"}, "static": static},
        {"columns": columns, "static": {name: static[name] for name in ("sensor_uid", "driver")}},
        {"columns": columns, "static": static | {"sensor_type": np.zeros(n + 1, np.uint32)}},
    ):
        with ServiceWriter("odd", namespace=into, **({"kind": "health"} | wrong)):  # type: ignore[arg-type]
            with pytest.raises(BadServiceFile):
                HealthReader("odd", namespace=into)
    with ServiceWriter("fine", columns, static, namespace=into, kind="health") as writer:
        arrays = writer.begin()
        for name, nothing in NOTHING.items():
            arrays[name][:] = nothing
        writer.commit(1)
        with HealthReader("fine", namespace=into) as reader, ServiceReader("fine", namespace=into):
            report = reader.read().report
            assert all(
                np.array_equal(getattr(report, name), getattr(HealthReport.unknown(n), name), equal_nan=True)
                for name in COLUMNS
            )
