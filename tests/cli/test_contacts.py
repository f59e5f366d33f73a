"""What skin-top tells of the contacts beside a driver."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt
import pytest
from textual.widgets import Static

from skinware import Namespace, Structure
from skinware.cli import _top_app
from skinware.cli._command import exit_status
from skinware.cli._heat_map import arrange
from skinware.cli._painting import HeatMap
from skinware.cli._top_app import SkinTop
from skinware.cli._top_rows import TITLES, contact_text, labels_of, line_of, lines_of
from skinware.cli.top import command
from skinware.geometry import Geometry
from skinware.realtime import now_ns
from skinware.sensor_types import PRESSURE
from skinware.tactile.contacts_service import ContactsReader, ContactsWriter
from skinware.views.live import LiveSources, places_of
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.cli.test_top_app import go, line, picture, shown, until
from tests.tactile.skins import AT_ONCE, triangles


def placed_structure() -> Structure:
    """Two boards of four triangles of ten taxels, in eight rows of ten."""
    structure = fake_structure(2, 4)
    geometry = Geometry.unknown(["pressure"] * 80, structure.sensor_uid[structure.index("pressure")])
    geometry.position_m[:], geometry.normal[:], geometry.frame[:] = triangles(8, 10), (0, 0, 1), "arm"
    return structure.placed(geometry)


def pressed(*taxels: int) -> npt.NDArray[np.float64]:
    """(80,) 50 counts on some taxels."""
    value = np.zeros(80)
    value[list(taxels)] = 50
    return value


@contextmanager
def touched_skin(*taxels: int, driver: str = "a") -> Iterator[ContactsWriter]:
    """Driver ``a`` that has published a frame, and contacts of ``driver`` on some taxels; default: two contacts."""
    value = pressed(*(taxels or (22, 23, 33, 78)))
    with (
        FakeSkin("a", placed_structure()) as skin,
        ContactsWriter(skin.structure, driver=driver, tracking=AT_ONCE) as contacts,
    ):
        skin.publish(2)
        contacts.publish(value, value > 0, now_ns())
        yield contacts


@pytest.fixture(autouse=True)
def look_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.drivers.LOOK_EVERY_NS", 0)
    monkeypatch.setattr(_top_app, "_LIST_PERIOD_S", 0.1)


def test_plain_lines_and_json_tell_where_contacts_are(capsys: pytest.CaptureFixture[str]) -> None:
    with touched_skin():
        assert exit_status(command, ["--plain", "-T", "0.01"]) == 0
        first, *lines = capsys.readouterr().out.splitlines()
        assert exit_status(command, ["--json", "-T", "0.01"]) == 0
        (told,) = map(json.loads, capsys.readouterr().out.splitlines())
    assert first.startswith("a  ")
    assert [text.strip().split("  ")[:3] for text in lines] == [
        ["contact 1", "touch", "board 7, triangle 2"],
        ["contact 2", "touch", "board 8, triangle 3"],
    ]
    assert "load 150 counts  3 taxels  0 mm/s  for 0.0 ms" in lines[0]
    contact = told["contacts"][0]
    assert np.allclose(contact["cop_m"], triangles(8, 10)[[22, 23, 33]].mean(axis=0), atol=1e-5)
    assert (contact["load"], contact["frame"], contact["force_n"]) == (150, "arm", None)


def test_without_a_service_or_with_that_of_another_driver_there_are_none(capsys: pytest.CaptureFixture[str]) -> None:
    with touched_skin(driver="b"):
        assert exit_status(command, ["--json", "-T", "0.01"]) == 0
    assert json.loads(capsys.readouterr().out)["contacts"] == []


def test_contacts_of_other_sensors_than_the_driver_has_are_not_told() -> None:
    with touched_skin() as writer, ContactsReader(writer.name) as reader:
        frame = reader.read(timeout_s=10)
        assert len(places_of(frame, placed_structure())) == 2
        assert places_of(frame, fake_structure(2, 3)) == []
        only_temperature = fake_structure(2, 4).types[1:]
        structure = fake_structure(2, 4)
        other = structure.replace(
            types=only_temperature, sensor_type=np.full(structure.n_sensors, only_temperature[0].id)
        )
        assert places_of(frame, other) == []
        assert places_of(None, structure) == []


def test_where_nobody_knows_places_a_contact_is_on_its_first_module() -> None:
    structure = fake_structure(2, 4)
    with ContactsWriter(structure, driver="a", tracking=AT_ONCE) as writer, ContactsReader(writer.name) as reader:
        value = pressed(11, 14)
        writer.publish(value, value > 0, now_ns())
        (place,) = places_of(reader.read(timeout_s=10), structure)
    assert place.module == "board 7, triangle 1"
    assert "-" in line_of(place)
    assert "at - m" in contact_text(place)


def test_lines_fit_80_columns_and_what_has_no_room_is_counted() -> None:
    apart = [row * 10 + column for row in (0, 3, 6) for column in (0, 3, 6, 9)]
    with touched_skin(*apart) as writer, ContactsReader(writer.name) as reader:
        places = places_of(reader.read(timeout_s=10), placed_structure())
    assert len(places) == 12
    assert max(len(text) for text in (TITLES, *map(line_of, places))) <= 78
    long = places[0]._replace(module="the left forearm of a robot, triangle 3")
    assert len(line_of(long)) == len(line_of(places[0]))
    assert lines_of(places, 30) == [TITLES, *map(line_of, places)]
    assert lines_of(places, 13) == [TITLES, *map(line_of, places)]
    assert lines_of(places, 5) == [TITLES, *map(line_of, places[:3]), "and 9 more"]
    assert lines_of(places, 2) == [TITLES, "12 more"]
    assert lines_of([], 5) == [TITLES]
    assert lines_of([], 0) == [TITLES]


def test_labels_stand_over_the_sensors_that_are_drawn() -> None:
    structure = placed_structure()
    with touched_skin() as writer, ContactsReader(writer.name) as reader:
        first, second = places = places_of(reader.read(timeout_s=10), structure)
    arrangement = arrange(structure, [0, 1], "pressure", 100, 30)
    labels = labels_of(places, arrangement)
    assert sum(map(len, labels.values())) == 2
    for place in places:
        ((at, label),) = [
            (at, one) for at, of_line in labels.items() for one in of_line if one.text == str(place.contact.id)
        ]
        assert label.is_mark
        assert arrangement.sensor_at(at, label.column) == place.sensor
    only_first_board = arrange(structure, [0], "pressure", 100, 30)
    ((label,),) = labels_of(places, only_first_board).values()
    assert label.text == str(first.contact.id)
    assert labels_of([second], only_first_board) == {}


def test_services_that_come_and_go_are_followed() -> None:
    contacts = LiveSources(Namespace(), ContactsReader)
    with touched_skin() as writer:
        contacts.look()
        frame = contacts.of("a")
        assert frame is not None
        assert len(frame.contacts) == 2
        assert contacts.of("b") is None
        writer.go_on(fake_structure(1, 2))
        assert contacts.of("a") is None  # nothing published yet
        value = np.arange(20) == 3
        writer.publish(value * 5.0, value, now_ns())
        wait_until(lambda: contacts.of("a") is not None)
    assert contacts.of("a") is None
    contacts.look()
    contacts.close()
    contacts.close()


def marked(app: SkinTop) -> list[tuple[str, int | None]]:
    """What is written over the picture, as it is drawn, each with the position of the sensor below."""
    heat_map, drawn = app.query_one(HeatMap), picture(app)
    assert heat_map._arrangement is not None
    return [
        (drawn[at][label.column :][: len(label.text)], heat_map._arrangement.sensor_at(at, label.column))
        for at, labels in heat_map._marks.items()
        for label in labels
    ]


def test_the_view_follows_a_contact() -> None:
    async def scene() -> None:
        skin = FakeSkin("a", placed_structure())
        async with shown((90, 30)) as (app, pilot):
            with publishing(skin):
                await until(pilot, lambda: bool(line(app, "marks")))
                assert not app.query_one("#contacts", Static).display
                with ContactsWriter(skin.structure, driver="a", tracking=AT_ONCE) as writer:
                    begin_ns = now_ns()
                    moves = ((0, 29, "board 7, triangle 2"), (20_000_000, 30, "board 7, triangle 3"))
                    for after_ns, taxel, module in moves:
                        writer.publish(pressed(taxel), pressed(taxel) > 0, begin_ns + after_ns)
                        sensor = int(np.flatnonzero(skin.structure.sensor_type == PRESSURE.id)[taxel])
                        wanted = [(f"{taxel - 28}", sensor)]
                        await until(pilot, lambda wanted=wanted: marked(app) == wanted)  # type: ignore[misc]
                        titles, contact = line(app, "contacts").splitlines()
                        assert titles == TITLES
                        assert contact.split()[0] == f"{taxel - 28}"
                        assert module in contact
                    writer.publish(pressed(), pressed() > 0, begin_ns + 200_000_000)
                    await until(pilot, lambda: line(app, "contacts") == TITLES and not marked(app))
                    heat_map, panel = app.query_one(HeatMap), app.query_one("#contacts", Static)
                    assert app.screen.region.contains_region(panel.region)
                    assert heat_map.region.intersection(panel.region).area == 0
                await until(pilot, lambda: not app.query_one("#contacts", Static).display)

    go(scene)
