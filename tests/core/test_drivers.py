"""The drivers of a namespace, or its services of another kind: which are followed, and until when."""

from __future__ import annotations

from functools import partial

import pytest

from skinware import DriverReader, DriverWriter, Namespace, Sample, ServiceReader, ServiceWriter
from skinware.drivers import Drivers
from skinware.errors import NamespaceError
from tests.cli.fake_skin import fake_structure
from tests.core.services import SMALL, kill, publish

STRUCTURE = fake_structure(1, 1)


def all_services(namespace: Namespace) -> Drivers[ServiceReader[Sample]]:
    return Drivers(namespace, partial(ServiceReader[Sample], announce=False), every_ns=0)


def test_a_service_is_followed_as_long_as_its_file_is_there(namespace: Namespace) -> None:
    with all_services(namespace) as services:
        assert not services.look()
        with ServiceWriter("b", SMALL), ServiceWriter("a", SMALL) as writer:
            assert services.look()
            assert list(services.readers) == ["a", "b"]
            assert not services.look()
            assert services.newest("a") is None
            publish(writer, 1)
            sample = services.newest("a")
            assert sample.sequence == 1
            assert services.newest("a", newer_than=sample) is None
        assert services.look()
        assert not services.readers
        assert services.newest("a") is None


def test_a_dead_service_stays_unless_only_living_ones_are_wanted(namespace: Namespace) -> None:
    writer = ServiceWriter("a", SMALL)
    with all_services(namespace) as services, Drivers(namespace, ServiceReader[Sample], only_living=True) as living:
        living.look()
        assert not living.readers  # it has published nothing
        publish(writer, 1)
        kill(writer)
        services.look()
        living.look(at_once=True)
        assert services.newest("a").stale
        assert not living.readers
    ServiceWriter("a", SMALL).close()


def test_a_service_with_another_structure_is_still_followed_if_it_is_wanted(namespace: Namespace) -> None:
    small, large = STRUCTURE, fake_structure(2, 2)
    asked: list[int] = []

    def wants(reader: DriverReader) -> bool:
        asked.append(reader.structure.n_sensors)
        return reader.structure.n_patches == 1

    drivers = Drivers(namespace, DriverReader, ["a"], wants=wants, every_ns=0)
    with drivers, DriverWriter("a", small) as writer, DriverWriter("other", small):
        drivers.look()
        assert list(drivers.readers) == ["a"]
        writer.restructure(fake_structure(1, 2))
        assert drivers.keep_up("a") is drivers.readers["a"]
        writer.restructure(large)
        assert drivers.keep_up("a") is None
        for _ in range(3):
            drivers.look()
        assert not drivers.readers
        assert asked == [12, 24, 48, 48]  # and not at every look
        writer.restructure(small)
        drivers.look()
        assert list(drivers.readers) == ["a"]


def test_a_service_of_another_kind_is_tried_once_and_says_why(namespace: Namespace) -> None:
    tried: list[str] = []

    def reader(name: str, *, namespace: Namespace) -> DriverReader:
        tried.append(name)
        return DriverReader(name, namespace=namespace)

    with Drivers(namespace, reader, every_ns=0) as drivers, ServiceWriter("pose", SMALL):
        for _ in range(3):
            drivers.look()
        assert tried == ["pose"]
        assert drivers.unreadable == {"pose": "service 'pose' is not a driver: it has no sensors"}
        assert drivers.trouble == ""
    drivers.look()
    assert drivers.unreadable == {}


def test_what_keeps_a_program_from_reading_is_a_trouble_while_it_lasts(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(name: str, **_: Namespace) -> ServiceReader[Sample]:
        raise NamespaceError("no more file descriptors")

    services = all_services(namespace)
    with services, ServiceWriter("a", SMALL):
        with monkeypatch.context() as patch:
            patch.setattr(services, "_reader", refuse)
            services.look()
            assert services.trouble == "no more file descriptors"
        services.look()
        assert services.trouble == ""
        assert list(services.readers) == ["a"]
