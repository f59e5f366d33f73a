"""A name's file is that of a dead driver, of another kind of service, or of a format to come."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Namespace, Sample, ServiceReader, ServiceWriter, Skin
from skinware import skin as skin_module
from skinware.errors import BadServiceFile, PeerGone, StructureChanged
from skinware.memory import file_layout
from tests.cli.fake_skin import BUS_COUNTERS, fake_structure
from tests.core.services import SMALL, kill, publish

STRUCTURE = fake_structure(1, 2)


def driver(name: str) -> DriverWriter:
    writer = DriverWriter(name, STRUCTURE, bus_counters=BUS_COUNTERS)
    publish(writer, 1)
    return writer


def look(skin: Skin) -> tuple[str, ...]:
    """The drivers of a skin that looks at every file now."""
    skin.refresh()
    return skin.read().layout.drivers


def of_another_kind(name: str) -> ServiceWriter:
    return ServiceWriter(name, SMALL)


def of_a_format_to_come(name: str) -> ServiceWriter:
    writer = ServiceWriter(name, SMALL, kind="driver")
    writer._ring.segment.data[8] = file_layout.VERSION[0] + 1
    return writer


@pytest.mark.parametrize("successor", [of_another_kind, of_a_format_to_come])
def test_a_driver_whose_name_becomes_something_else_leaves_the_skin_until_it_is_one_again(
    successor: Callable[[str], ServiceWriter], caplog: pytest.LogCaptureFixture
) -> None:
    told: list[str] = []
    skin = Skin(
        on_attach=lambda name, _: told.append(f"+{name}"),
        on_detach=lambda name, _: told.append(f"-{name}"),
    )
    with skin, driver("a"):
        first = driver("b")
        assert look(skin) == ("a", "b")
        kill(first)
        with successor("b") as other:
            publish(other, 1)
            for _ in range(5):
                assert look(skin) == ("a",)
        with driver("b"):
            assert look(skin) == ("a", "b")
    assert told == ["+a", "+b", "-b", "+b"]
    assert caplog.text.count("driver 'b' left the skin: ") == 1


@pytest.mark.parametrize("successor", [of_another_kind, of_a_format_to_come])
def test_its_reader_says_that_it_changed_and_reattach_says_what_it_is(
    successor: Callable[[str], ServiceWriter],
) -> None:
    first = driver("b")
    with DriverReader("b") as reader:
        frame = reader.read()
        kill(first)
        with successor("b") as other:
            publish(other, 1)
            assert reader.newest_position == frame.position
            assert reader.read().stale
            with pytest.raises(StructureChanged):
                reader.read(newer_than=frame)
            with pytest.raises(BadServiceFile):
                reader.reattach()
            assert reader.read().position == frame.position
            if successor is of_a_format_to_come:
                with pytest.raises(PeerGone, match="dead, or is one that this program cannot read"):
                    reader.ask("rebaseline")
        with driver("b"):
            reader.reattach()
            assert not reader.read().stale


@pytest.fixture
def attached(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the services that a skin has attached to."""
    names: list[str] = []

    class Counted(skin_module._SkinReader):
        def __init__(self, name: str, **options: Any) -> None:
            names.append(name)
            super().__init__(name, **options)

    monkeypatch.setattr(skin_module, "_SkinReader", Counted)
    return names


def test_what_a_killed_driver_left_costs_a_skin_nothing(namespace: Namespace, attached: list[str]) -> None:
    """Neither is its structure read, nor a reader of it announced."""
    with driver("live"), Skin() as skin:
        kill(driver("dead"))
        assert look(skin) == ("live",)
        announced = namespace.readers_path.stat().st_mtime_ns
        for _ in range(5):
            assert look(skin) == ("live",)
        assert attached == ["live"]
        assert namespace.readers_path.stat().st_mtime_ns == announced
    ServiceWriter("dead", SMALL).close()  # clears it away


def test_a_living_service_that_is_no_driver_is_looked_at_once(
    namespace: Namespace, attached: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with driver("live"), ServiceWriter("pose", SMALL) as pose, Skin() as skin:
        publish(pose, 1)
        for _ in range(5):
            assert look(skin) == ("live",)
        assert sorted(attached) == ["live", "pose"]
        assert len(list(namespace.reader_files())) == 1
        pose.restructure({"values": ("u1", 1)})  # another file
        publish(pose, 1)
        look(skin)
        assert sorted(attached) == ["live", "pose", "pose"]
        with monkeypatch.context() as patched:  # a refusal may have been want of memory
            later_ns = time.monotonic_ns() + 61_000_000_000
            patched.setattr("skinware.drivers.now_ns", lambda: later_ns)
            look(skin)
        assert sorted(attached) == ["live", "pose", "pose", "pose"]


def test_a_driver_that_has_published_nothing_is_not_attached_to(attached: list[str]) -> None:
    with driver("live"), DriverWriter("new", STRUCTURE) as new, Skin() as skin:
        assert look(skin) == ("live",)
        assert attached == ["live"]
        publish(new, 1)
        assert look(skin) == ("live", "new")


class Odd(ServiceWriter):
    """A driver's service with other tables or columns than a driver has."""

    def __init__(self, tables: dict[str, Any], columns: dict[str, Any]) -> None:
        with DriverWriter("whole", STRUCTURE, driver_type="fake", bus_counters=BUS_COUNTERS) as whole:
            all_tables, all_columns = {**whole._static, **tables}, {**whole._ring.segment.schema.columns, **columns}
        super().__init__(
            "odd",
            {name: column for name, column in all_columns.items() if column is not None},
            {name: table for name, table in all_tables.items() if table is not None},
            kind="driver",
        )
        publish(self, 0)


@pytest.mark.parametrize(
    ("tables", "columns"),
    [
        ({"driver_type": None, "bus_counter_name": None}, {"bus_counters": None}),
        ({"driver_type": np.zeros(0, "S32")}, {"bus_counters": None}),
    ],
)
def test_what_a_driver_need_not_tell_may_be_missing(tables: dict[str, Any], columns: dict[str, Any]) -> None:
    with Odd(tables, columns), DriverReader("odd") as reader:
        frame = reader.read()
        assert reader.driver_type == ""
        assert reader.bus_counters(frame) == [{}]
        assert reader.patch_counters(frame) == [{}]


@pytest.mark.parametrize(
    ("tables", "columns"),
    [
        ({"bus_counter_name": np.array([b"lost"], "S24")}, {}),
        ({"bus_counter_name": np.array([b"\xff"] * len(BUS_COUNTERS), "S24")}, {}),
        ({"bus_counter_name": None}, {}),
        ({"driver_type": np.array([b"\xff"], "S32")}, {}),
        ({}, {"status": ("<f8", STRUCTURE.n_sensors)}),
        ({}, {"status": None}),
        ({}, {"bus_load": ("<u2", 2)}),
    ],
)
def test_what_contradicts_the_structure_is_refused(tables: dict[str, Any], columns: dict[str, Any]) -> None:
    with Odd(tables, columns), ServiceReader[Sample]("odd") as plain:
        assert plain.read().sequence == 1
        with pytest.raises(BadServiceFile):
            DriverReader("odd")
