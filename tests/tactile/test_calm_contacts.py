"""Contacts beside a calmed driver."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, Namespace, Status, Structure
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, SHEAR_X, TEMPERATURE
from skinware.tactile.calm_service import CalmService
from skinware.tactile.contacts_service import ContactsReader, ContactsWriter
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import running
from tests.tactile.reading import read_until
from tests.tactile.skins import triangles

REST, PRESSED = 200.0, 150.0


@pytest.fixture
def into(calm_namespace: Namespace) -> Namespace:
    """Where what is calmed is published."""
    return calm_namespace


def placed_structure() -> Structure:
    """Eight triangles of ten taxels, in eight rows of ten."""
    structure = fake_structure(2, 4)
    uid = structure.sensor_uid[structure.index("pressure")]
    geometry = Geometry.unknown(["pressure"] * 80, uid)
    geometry.position_m[:], geometry.normal[:], geometry.frame[:] = triangles(8, 10), (0, 0, 1), "palm"
    return structure.placed(geometry)


def press(skin: FakeSkin, *taxels: int) -> None:
    """Press some taxels of a skin that rests, counted among the taxels."""
    values = np.full(skin.structure.n_sensors, REST)
    if taxels:
        values[np.arange(skin.structure.n_sensors)[skin.structure.index("pressure")][list(taxels)]] = PRESSED
    skin.values = values


@contextmanager
def calming(into: Namespace, name: str = "fake", **how: Any) -> Iterator[CalmService]:
    """A service that runs in a thread, and has taken frames."""
    service = CalmService(name, into=into, **how)
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        wait_until(lambda: service.frames > 0)
        yield service
    finally:
        service.stop()
        thread.join()


def tare(into: Namespace, name: str = "fake") -> None:
    with DriverReader(name, namespace=into, timeout_s=10) as reader:
        reader.call("tare")


def test_a_driver_with_pressures_alone_has_contacts(into: Namespace) -> None:
    structure = Structure(
        types=[PRESSURE.measured(unit="counts")],
        buses=["can0"],
        patch_name=["palm"],
        patch_bus=[0],
        module_patch=[0],
        module_kind=["4x4"],
        sensor_uid=np.arange(16),
        sensor_type=[PRESSURE.id] * 16,
        sensor_module=np.zeros(16, int),
        dtype="u1",
    )
    skin = FakeSkin("fake", structure)
    skin.values = np.full(16, 20)
    with publishing(skin), calming(into), ContactsReader(namespace=into, timeout_s=10) as contacts:
        tare(into)
        skin.values = np.full(16, 20) + 50 * (np.arange(16) == 3)
        frame = read_until(contacts, lambda frame: len(frame.contacts) == 1 and not frame.contacts.provisional.any())
        assert [contact.taxels.tolist() for contact in frame] == [[3]]
        assert frame.contacts.load.tolist() == [50]


def test_contacts_stand_beside_the_calmed_driver(into: Namespace) -> None:
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    with publishing(skin), calming(into) as service, ContactsReader(namespace=into, timeout_s=10) as contacts:
        tare(into)
        assert len(contacts.read(timeout_s=10).contacts) == 0
        press(skin, 22, 23, 33, 78)
        frame = read_until(contacts, lambda frame: len(frame.contacts) == 2 and not frame.contacts.provisional.any())
        assert [contact.taxels.tolist() for contact in frame] == [[22, 23, 33], [78]]
        first, second = frame
        assert (first.load, first.peak, first.n, first.frame) == (150, 50, 3, "palm")
        assert np.allclose(first.cop_m, triangles(8, 10)[[22, 23, 33]].mean(axis=0))
        assert second.normal.tolist() == [0, 0, 1]
        source = contacts.source
        assert (source.driver, source.type_name, source.unit) == ("fake", "pressure", "counts")
        wait_until(lambda: service.status()["contacts"] == 2)
        press(skin, 23, 33)
        frame = read_until(contacts, lambda frame: len(frame.contacts) == 1)
        assert frame.contacts.id.tolist() == [first.id]


def test_a_second_calmed_driver_has_contacts_and_health_too(into: Namespace) -> None:
    left, right = FakeSkin("left", placed_structure()), FakeSkin("right", placed_structure())
    press(left)
    press(right)
    with ExitStack() as running:
        for skin in (left, right):
            running.enter_context(publishing(skin))
        first = running.enter_context(calming(into, "left"))
        second = running.enter_context(calming(into, "right"))
        assert (first.contacts.name, first.health.name) == ("contacts", "health")
        assert (second.contacts.name, second.health.name) == ("right-contacts", "right-health")
        contacts = running.enter_context(ContactsReader("right-contacts", namespace=into, timeout_s=10))
        assert contacts.source.driver == "right"
        tare(into, "right")
        press(right, 22)
        assert read_until(contacts, lambda frame: len(frame.contacts) == 1).contacts[0].taxels.tolist() == [22]


def test_what_says_nothing_now_touches_nothing(into: Namespace) -> None:
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    with publishing(skin), calming(into), ContactsReader(namespace=into, timeout_s=10) as contacts:
        tare(into)
        press(skin, 22, 78)
        read_until(contacts, lambda frame: len(frame.contacts) == 2)
        position = np.arange(skin.structure.n_sensors)[skin.structure.index("pressure")][78]
        skin.status[position] = Status.STALE
        frame = read_until(contacts, lambda frame: len(frame.contacts) == 1)
        assert frame.contacts[0].taxels.tolist() == [22]


def test_when_the_driver_is_gone_nothing_is_touched(into: Namespace) -> None:
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    with ExitStack() as driver:
        driver.enter_context(publishing(skin))
        with calming(into), ContactsReader(namespace=into, timeout_s=10) as contacts:
            tare(into)
            press(skin, 22)
            read_until(contacts, lambda frame: len(frame.contacts) == 1)
            driver.close()
            read_until(contacts, lambda frame: len(frame.contacts) == 0)


def test_a_contact_across_the_border_of_two_links_is_one(
    into: Namespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    structure = placed_structure()
    geometry = structure.geometry
    assert geometry is not None
    x = geometry.position_m[structure.index("pressure"), 0]
    middle = np.median(x)
    beside, border = int(np.where(x > middle, -1, x).argmax()), int(np.where(x > middle, x, 1).argmin())
    right = geometry.position_m[:, 0] > middle
    apart = replace(geometry, frame=np.where(right, "right", "left"), position_m=geometry.position_m.copy())
    apart.position_m[right] -= (0.3, 0, 0)
    links = tmp_path / "links.toml"
    left_link, right_link = 'frame = "left"', 'frame = "right"\nxyz = [0.3, 0, 0]'
    links.write_text(f'format = "skinware-links"\nversion = 1\n[[link]]\n{left_link}\n[[link]]\n{right_link}\n')
    skin = FakeSkin("fake", structure.placed(apart))
    press(skin)
    with publishing(skin):
        for options, number in (("--links", str(links)), 1), ((), 2):
            with running("skin-calm", "fake", "--into", into.name, *options) as command:
                command.wait_for("ready")
                with ContactsReader(namespace=into, timeout_s=10) as contacts:
                    tare(into)
                    press(skin, border, beside)
                    sample = read_until(contacts, lambda frame: len(frame.contacts) > 0)
                    assert len(sample.contacts) == number
                    press(skin)


@pytest.mark.thorough
def test_contacts_follow_another_structure(into: Namespace) -> None:
    with ExitStack() as driver:
        skin = FakeSkin("fake", placed_structure())
        press(skin)
        driver.enter_context(publishing(skin))
        with calming(into), ContactsReader(namespace=into, timeout_s=10) as contacts:
            assert len(contacts.source.uid) == 80
            driver.close()
            other = FakeSkin("fake", fake_structure(1, 2))
            press(other)
            driver.enter_context(publishing(other))
            wait_until(lambda: contacts.refresh() is None or contacts.structure_changed)
            contacts.reattach()
            tare(into)
            press(other, 3, 9, 12)
            frame = read_until(contacts, lambda frame: len(frame.contacts) == 2)
            assert [contact.taxels.tolist() for contact in frame] == [[3, 9], [12]]  # by module: there are no places
            assert len(contacts.source.uid) == 20


def test_a_name_can_be_chosen_and_a_service_left_out(into: Namespace) -> None:
    structure = fake_structure(1, 2)
    with publishing(FakeSkin("leg", structure)):
        with calming(into, "leg", contacts="leg_contacts"):
            with ContactsReader("leg_contacts", namespace=into, timeout_s=10) as contacts:
                assert contacts.source.driver == "leg"
        with calming(into, "leg", contacts=None, health=None):
            assert into.services() == ["leg"]


def test_contacts_whose_names_are_both_taken_cost_only_the_contacts(
    into: Namespace, caplog: pytest.LogCaptureFixture
) -> None:
    structure = fake_structure(1, 2)
    with ExitStack() as others:
        for name in ("contacts", "leg-contacts"):
            others.enter_context(FakeSkin(name, structure, into))
        others.enter_context(publishing(FakeSkin("leg", structure)))
        with caplog.at_level(logging.WARNING), calming(into, "leg") as service:
            assert service.contacts.name == ""
            assert "no contacts of 'leg': " in caplog.text


def test_a_driver_that_feels_no_pressure_has_no_contacts(into: Namespace) -> None:
    structure = fake_structure(1, 2)
    ids = np.array([TEMPERATURE.id, SHEAR_X.id], np.uint32)
    other = structure.replace(types=(TEMPERATURE, SHEAR_X), sensor_type=ids[np.arange(structure.n_sensors) % 2])
    skin = FakeSkin("fake", other)
    skin.values = np.full(structure.n_sensors, REST)
    with publishing(skin), calming(into) as service:
        assert into.services() == ["fake"]
        assert service.status()["contacts"] == 0


def test_the_command_tells_of_its_contacts(into: Namespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    skin = FakeSkin("fake", placed_structure())
    press(skin)
    with publishing(skin):
        with running("skin-calm", "fake", "--into", into.name) as command:
            assert command.wait_for("ready")["contacts"] == "contacts"
            assert command.wait_for("status")["contacts"] == 0
        with running("skin-calm", "fake", "--into", into.name, "--contacts", "") as command:
            assert command.wait_for("ready")["contacts"] == ""
            assert sorted(into.services()) == ["fake", "health"]
        with ContactsWriter(skin.structure, namespace=into, name="mine"):
            with running("skin-calm", "fake", "--into", into.name, "--contacts", "mine") as command:
                assert command.wait_for("ready")["contacts"] == "fake-mine"
