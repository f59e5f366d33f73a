"""Contacts from program to program."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from skinware import Column, Namespace, ServiceReader, ServiceWriter, Structure
from skinware.errors import BadServiceFile, ConfigurationError, NameInUse, StructureChanged, StructureError
from skinware.realtime import now_ns
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.tactile.contacts import BEYOND, COLUMNS, MOST, NO_CONTACT, Contacts, ContactSet
from skinware.tactile.contacts_service import ContactsReader, ContactsWriter
from tests.tactile.skins import AT_ONCE, PITCH_M, placed, pressed, triangles

FLAT = triangles(20, 20)


def structure(with_places: bool = True, unit: str = "Pa", rows: int = 20) -> Structure:
    """Taxels of 20 to a module, and a temperature in each module before them."""
    types = (TEMPERATURE, PRESSURE.measured(unit=unit))
    n = 20 * rows
    made = Structure(
        types=types,
        buses=["can0"],
        patch_name=["board 1"],
        patch_bus=[0],
        module_patch=[0] * rows,
        module_kind=["row"] * rows,
        sensor_uid=[*range(rows), *range(100, 100 + n)],
        sensor_type=[TEMPERATURE.id] * rows + [PRESSURE.id] * n,
        sensor_module=[*range(rows), *np.repeat(np.arange(rows), 20)],
        dtype="<f4",
    )
    if not with_places:
        return made
    geometry = placed(FLAT[:n])
    geometry.uid[:] = np.arange(100, 100 + n)
    return made.placed(geometry)


def equal(one: ContactSet, other: ContactSet) -> bool:
    fields = [field.name for field in dataclasses.fields(ContactSet)]
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name not in ("frames", "beyond"))
        for name in fields
    )


def test_what_was_published_is_read(namespace: Namespace) -> None:
    value = pressed(FLAT, [[0.02, 0.02, 0], [0.1, 0.08, 0]], 3 * PITCH_M, load=1000.0)
    with (
        ContactsWriter(structure(), driver="torso", tracking=AT_ONCE, namespace=namespace) as writer,
        ContactsReader(namespace=namespace, timeout_s=10) as contacts,
    ):
        for time_ns in range(10**9, 2 * 10**9, 2 * 10**8):
            published = writer.publish(value, value > 0, time_ns)
        frame = contacts.read(timeout_s=10)
        assert frame.acquired_ns == time_ns
        assert equal(frame.contacts, published)
        assert [contact.id for contact in frame] == [1, 2]
        assert [contact.frame for contact in frame] == ["chest", "chest"]
        taxels = np.concatenate([contact.taxels for contact in frame])
        assert np.array_equal(np.sort(taxels), np.flatnonzero(value))
        assert np.array_equal(contacts.source.uid[taxels], 100 + taxels)
        source = contacts.source
        assert (source.driver, source.type_name, source.unit, source.frames) == ("torso", "pressure", "Pa", ("chest",))
        assert all(contact.force_n > 0 for contact in frame)


def test_any_program_sees_columns_of_64_rows(namespace: Namespace) -> None:
    with ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace) as writer:
        value = np.zeros(400)
        value[::2] = 1.0
        writer.publish(value, value > 0, 1)
        value[::] = 0
        value[7] = 2.0
        writer.publish(value, value > 0, 2)
        with ServiceReader(writer.name, namespace=namespace) as reader:
            frame = reader.read(timeout_s=10)
            for name, (dtype, shape, *_) in COLUMNS.items():
                column = frame.column(name)
                assert (column.dtype, column.shape) == (np.dtype(dtype), (MOST, *shape))
                rest = column[1:]
                assert np.isnan(rest).all() if dtype == "<f4" else (rest == (-1 if name == "frame" else 0)).all()
            assert (frame.column("count")[0], frame.column("beyond")[0]) == (1, 0)
            assert np.flatnonzero(frame.column("contact_of") != NO_CONTACT).tolist() == [7]
            assert reader.schema.columns["load"].unit == "Pa"
            assert reader.schema.columns["velocity_m_s"].unit == "m/s"
            assert all(column.description for column in reader.schema.columns.values())
            assert reader.kind == "contacts"


def test_more_contacts_than_rows(namespace: Namespace) -> None:
    single = structure(with_places=False)
    apart = np.full((400, 1), -1)
    apart[0] = 1
    with ContactsWriter(single, neighbours=apart, tracking=AT_ONCE, namespace=namespace) as writer:
        writer._contacts = Contacts(400, tracking=AT_ONCE)  # each alone
        writer.publish(np.arange(400), np.ones(400, bool), 1)
        with ContactsReader(namespace=namespace) as contacts:
            found = contacts.read(timeout_s=10).contacts
            assert (len(found), found.beyond) == (MOST, 400 - MOST)
            assert (found.contact_of[: 400 - MOST] == BEYOND).all()


def test_without_places_modules_are_blobs(namespace: Namespace) -> None:
    with (
        ContactsWriter(structure(with_places=False), tracking=AT_ONCE, namespace=namespace) as writer,
        ContactsReader(namespace=namespace) as contacts,
    ):
        value = np.zeros(400)
        value[[20, 39, 50]] = 1
        writer.publish(value, value > 0, 1)
        frame = contacts.read(timeout_s=10)
        assert [contact.taxels.tolist() for contact in frame] == [[20, 39], [50]]
        assert contacts.source.frames == ()
        assert np.isnan(frame.contacts.cop_m).all()


def test_a_reader_goes_on_with_other_sensors_when_it_says_so(namespace: Namespace) -> None:
    with (
        ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace) as writer,
        ContactsReader(namespace=namespace) as contacts,
    ):
        writer.publish(np.ones(400), np.ones(400, bool), 1)
        frame = contacts.read(timeout_s=10)
        writer.go_on(structure(rows=10))
        writer.publish(np.ones(200), np.ones(200, bool), 2)
        with pytest.raises(StructureChanged):
            contacts.read(newer_than=frame, timeout_s=10)
        contacts.reattach()
        assert len(contacts.source.uid) == 200
        assert contacts.read(timeout_s=10).contacts.n.tolist() == [200]
        with pytest.raises(StructureError):
            writer.go_on(
                structure().replace(
                    types=(TEMPERATURE, PRESSURE.measured()),
                    geometry=None,
                    sensor_type=[TEMPERATURE.id] * 20 + [99] * 400,
                )
            )
        writer.publish(np.ones(200), np.ones(200, bool), 3)
        assert contacts.read(timeout_s=10).acquired_ns == 3


def test_a_new_writer_is_read_without_a_word(namespace: Namespace) -> None:
    with ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace) as writer:
        writer.publish(np.ones(400), np.ones(400, bool), 1)
        contacts = ContactsReader(namespace=namespace)
        frame = contacts.read(timeout_s=10)
    with ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace) as writer, contacts:
        writer.publish(np.ones(400), np.ones(400, bool), 2)
        assert contacts.read(newer_than=frame, timeout_s=10).acquired_ns == 2


def test_what_is_no_service_of_contacts_is_refused(namespace: Namespace) -> None:
    with ServiceWriter("contacts", {"id": ("<u4", 64)}, namespace=namespace):
        with pytest.raises(BadServiceFile, match="not of kind 'contacts'"):
            ContactsReader(namespace=namespace)
    columns = {"id": Column(np.dtype("<u4"), (63,))}
    with ServiceWriter("contacts", columns, namespace=namespace, kind="contacts"):
        with pytest.raises(BadServiceFile, match="not attached"):
            ContactsReader(namespace=namespace)


def test_a_second_writer_and_wrong_arrays_are_refused(namespace: Namespace) -> None:
    with ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace) as writer:
        with pytest.raises(NameInUse):
            ContactsWriter(structure(), namespace=namespace)
        with pytest.raises(ConfigurationError, match="contacts of 400 taxels"):
            writer.publish(np.ones(3), np.ones(3, bool), 1)
    with pytest.raises(StructureError, match="no sensor type 'shear_x'"):
        ContactsWriter(structure(), "shear_x", namespace=namespace)
    with pytest.raises(ConfigurationError, match="neighbours of 400 taxels"):
        ContactsWriter(structure(), neighbours=np.zeros((3, 1), int), namespace=namespace)


def test_the_contact_on_a_region_is_there_at_once(namespace: Namespace) -> None:
    two = pressed(FLAT, [[0.02, 0.02, 0], [0.1, 0.08, 0]], 3 * PITCH_M, load=1000.0)
    first = np.where(FLAT[:, 0] < 0.06, two, 0)  # the one near the corner alone
    corner, rest = np.flatnonzero(FLAT[:, 0] < 0.06), np.flatnonzero(FLAT[:, 0] >= 0.06)
    with (
        ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace, slots=8) as writer,
        ContactsReader(namespace=namespace) as contacts,
    ):
        assert contacts.on(corner) is None
        start_ns = now_ns()
        writer.publish(two, two > 0, start_ns - 60_000_000)
        writer.publish(first, first > 0, start_ns)
        found = contacts.on(corner, above=1.0)
        assert found is not None
        assert np.isin(found.taxels, corner).all()
        assert contacts.on(corner.reshape(-1, 1), above=1e9) is None
        assert contacts.on(rest) is None  # not any more
        earlier = contacts.on(rest, within_s=600)
        assert earlier is not None
        assert np.isin(earlier.taxels, rest).all()
        assert contacts.on(slice(0, 400)).id == found.id  # type: ignore[union-attr]


def test_an_old_contact_is_not_within_a_short_time(namespace: Namespace) -> None:
    value = pressed(FLAT, [[0.02, 0.02, 0]], 3 * PITCH_M, load=1000.0)
    with (
        ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace) as writer,
        ContactsReader(namespace=namespace) as contacts,
    ):
        writer.publish(value, value > 0, now_ns() - 10**9)
        assert contacts.on(slice(None)) is not None
        assert contacts.on(slice(None), within_s=0.5) is None
