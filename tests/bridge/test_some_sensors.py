"""Some sensors of a robot travel, and are here what they are there."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import DriverReader, DriverWriter, Structure
from skinware.bridge.messages import Wish
from skinware.bridge.parts import Cut
from skinware.errors import StructureError
from skinware.geometry import Geometry
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.service import ServiceReader, ServiceWriter
from skinware.tactile import Region
from skinware.transfer.generation import Generation
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.net import Net
from tests.bridge.rig import Ends, joining, network, serving

PATIENCE_S = 10.0
PATCHES = {"palm": 0, "thumb": 1, "wrist": 1}
"""With the bus of each: three modules, each of four taxels and a temperature."""


@pytest.fixture
def net() -> Iterator[Net]:
    with network() as net:
        yield net


def hand(patches: tuple[str, ...] = tuple(PATCHES)) -> Structure:
    modules = 3 * len(patches)
    types = np.tile([PRESSURE.id] * 4 + [TEMPERATURE.id], modules)
    uid = np.concatenate([1000 * [*PATCHES].index(patch) + np.arange(15) for patch in patches])
    names = {PRESSURE.id: "pressure", TEMPERATURE.id: "temperature"}
    structure = Structure(
        types=[PRESSURE.measured(unit="counts"), TEMPERATURE.measured(unit="counts")],
        buses=["can0", "can1"],
        patch_name=list(patches),
        patch_bus=[PATCHES[patch] for patch in patches],
        module_patch=np.repeat(np.arange(len(patches)), 3),
        module_kind=["triangle"] * modules,
        sensor_uid=uid,
        sensor_type=types,
        sensor_module=np.arange(5 * modules) // 5,
        dtype="u2",
    )
    unknown = Geometry.unknown([names[each] for each in types.tolist()], structure.sensor_uid)
    return structure.replace(geometry=unknown)


def driver(namespace: Namespace, operations: Mapping[str, Callable[..., object]] | None = None) -> DriverWriter:
    return DriverWriter(
        "hand",
        hand(),
        namespace=namespace,
        operations=operations,
        rate_hz=50,
        driver_type="virtual",
        bus_counters=["dropped", "read"],
        patch_counters=["late"],
    )


def publish(writer: DriverWriter) -> dict[str, npt.NDArray[Any]]:
    """A frame in which every number tells where it belongs; its columns."""
    columns = writer.begin()
    structure, time_ns = writer.structure, now_ns()
    columns["values"][:] = structure.sensor_uid % 65536 + writer.sequence
    columns["status"][:] = structure.sensor_uid % 7 == 0
    columns["module_time_ns"][:] = time_ns - np.arange(structure.n_modules)
    columns["patch_state"][:] = 1 + np.arange(structure.n_patches)
    columns["bus_state"][:] = 1 + np.arange(2)
    columns["bus_counters"][:] = [10, 11, 20, 21]
    columns["patch_counters"][:] = 100 + np.arange(structure.n_patches)
    columns["patch_age_counts"].reshape(structure.n_patches, -1)[:] = np.arange(structure.n_patches)[:, None]
    kept = {name: column.copy() for name, column in columns.items()}
    writer.commit(time_ns)
    return kept


def until_here(ends: Ends, writer: DriverWriter) -> None:
    """Until a driver publishes in the other namespace."""

    def is_here() -> bool:
        publish(writer)
        return writer.name in ends.here.services()

    wait_until(is_here)


def here_as(ends: Ends, writer: DriverWriter, condition: Callable[[DriverReader], bool]) -> None:
    """Until what is read in the other namespace fulfils a condition."""

    def fulfils() -> bool:
        publish(writer)
        try:
            with DriverReader(writer.name, namespace=ends.here) as reader:
                return reader.newest_position is not None and condition(reader)
        except Exception:  # noqa: BLE001, not there yet
            return False

    wait_until(fulfils)


def troubles(ends: Ends) -> list[str]:
    return [event["why"] for event in ends.events if event["event"] == "trouble"]


# -- cutting ------------------------------------------------------------------------------------------------------


def generation_of(namespace: Namespace) -> tuple[Generation, ServiceReader[Any]]:
    reader: ServiceReader[Any] = ServiceReader("hand", namespace=namespace)
    return Generation(reader._ring.segment.head, "hand"), reader


@pytest.mark.parametrize("seed", range(20))
def test_every_number_of_a_cut_belongs_to_what_stays(namespace: Namespace, seed: int) -> None:
    generator = np.random.default_rng(seed)
    with driver(namespace) as writer:
        publish(writer)
        whole, reader = generation_of(namespace)
        with reader:
            count = int(generator.integers(1, 46))
            positions = np.sort(generator.choice(45, count, replace=False))
            cut = Cut(whole, positions)
            frame, full = cut.frame(reader.read()), reader.read()
            structure, there = frame.structure, writer.structure
            assert structure.sensor_uid.tolist() == there.sensor_uid[positions].tolist()
            assert frame.values.tolist() == there.sensor_uid[positions].tolist()
            assert frame.status.tolist() == (there.sensor_uid[positions] % 7 == 0).tolist()
            assert (frame.position, frame.acquired_ns) == (full.position, full.acquired_ns)
            modules = there.sensor_module[positions]
            assert frame.module_time_ns[structure.sensor_module].tolist() == (
                full.column("module_time_ns")[modules].tolist()
            )
            known_as = [there.module_names[module] for module in modules.tolist()]
            assert [structure.module_names[module] for module in structure.sensor_module.tolist()] == known_as
            patches = {name: row for row, name in enumerate(there.patch_names)}
            for row, name in enumerate(structure.patch_names):
                assert structure.buses[structure.patch_bus[row]] == there.buses[PATCHES[name]]
                assert frame.patch_state[row] == 1 + patches[name]
                assert frame.column("patch_counters")[row] == 100 + patches[name]
                assert (frame.patch_age_counts[row] == patches[name]).all()
            buses = [there.buses.index(name) for name in structure.buses]
            assert frame.bus_state.tolist() == [1 + bus for bus in buses]
            assert frame.column("bus_counters").tolist() == [10 * (1 + bus) + n for bus in buses for n in (0, 1)]
            assert set(structure.sensor_type.tolist()) == {each.id for each in structure.types}
            assert structure.geometry is not None
            assert structure.geometry.uid.tolist() == structure.sensor_uid.tolist()


def test_nothing_and_what_is_no_driver_cannot_be_cut(namespace: Namespace) -> None:
    with driver(namespace) as writer, ServiceWriter("pump", {"x": ("<f8", 1)}, namespace=namespace) as pump:
        publish(writer)
        pump.begin()
        pump.commit(now_ns())
        whole, reader = generation_of(namespace)
        reader.close()
        with pytest.raises(StructureError, match="at least one sensor"):
            Cut(whole, np.zeros(0, np.int64))
        with ServiceReader("pump", namespace=namespace) as other:
            with pytest.raises(StructureError, match="not a driver"):
                Cut(Generation(other._ring.segment.head, "pump"), np.array([0]))


# -- over a bridge ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["push", "pull"])
def test_only_those_sensors_are_here(net: Net, namespace: Namespace, mode: str) -> None:
    wish = Wish(patches=("thumb",))
    with joining(net, namespace, mode, wish=wish) as ends, serving(net, namespace), driver(namespace) as writer:
        with ServiceWriter("pump", {"x": ("<f8", 1)}, namespace=namespace) as pump:
            pump.begin()
            pump.commit(now_ns())
            until_here(ends, writer)
            with DriverReader("hand", namespace=ends.here, timeout_s=PATIENCE_S) as reader:
                assert reader.structure.patch_names == ("thumb",)
                assert reader.structure.buses == ("can1",)
                assert reader.structure.sensor_uid.tolist() == list(range(1000, 1015))
                for _ in range(5):
                    values = publish(writer)["values"][15:30]
                    wait_until(lambda values=values: reader.read().values.tolist() == values.tolist())  # type: ignore[misc]
                assert reader.patch_counters(reader.read()) == [{"late": 101}]
            assert "pump" not in ends.here.services()
    assert not troubles(ends)


def test_joiners_of_different_parts_each_have_their_own(net: Net, namespace: Namespace) -> None:
    big = Region("big", frame=("nowhere",), regions=("small",))
    wishes = {
        "palm": Wish(patches=("palm",)),
        "both": Wish(patches=("palm", "wrist")),
        "region": Wish(in_regions=("big",), regions=(Region("small", type="pressure", uid=(2, 1001, 2010)), big)),
        "some": Wish(("palm",), ("warm",), (Region("warm", type="temperature", patch=("palm", "thumb")),)),
    }
    expected = {
        "palm": [*range(15)],
        "both": [*range(15), *range(2000, 2015)],
        "region": [2, 1001, 2010],
        "some": [4, 9, 14],
        "all": hand().sensor_uid.tolist(),
    }
    with ExitStack() as stack:
        stack.enter_context(serving(net, namespace))
        writer = stack.enter_context(driver(namespace))
        ends = {
            into: stack.enter_context(joining(net, namespace, mode, wish=wishes.get(into), into=into))
            for into, mode in zip(expected, ("push", "pull", "push", "pull", "push"), strict=True)
        }
        for into, uid in expected.items():
            until_here(ends[into], writer)
            here_as(ends[into], writer, lambda reader, uid=uid: reader.structure.sensor_uid.tolist() == uid)  # type: ignore[misc]


def test_what_is_not_there_is_told_with_what_is(net: Net, namespace: Namespace) -> None:
    wish = Wish(patches=("palm", "tail"))
    with joining(net, namespace, wish=wish) as ends, serving(net, namespace), driver(namespace) as writer:
        until_here(ends, writer)
        wait_until(
            lambda: "robot walle: no patch 'tail'; there are: palm, thumb, wrist" in troubles(ends),
        )


def test_a_part_vanishes_and_comes_back(net: Net, namespace: Namespace) -> None:
    with (
        joining(net, namespace, "push", wish=Wish(patches=("thumb",))) as ends,
        serving(net, namespace),
        driver(namespace) as writer,
    ):
        until_here(ends, writer)
        for _ in range(2):
            writer.restructure(hand(("palm", "wrist")))

            def is_gone() -> bool:
                publish(writer)
                return "hand" not in ends.here.services()

            wait_until(is_gone)
            writer.restructure(hand(("wrist", "thumb")))
            until_here(ends, writer)
            here_as(ends, writer, lambda reader: reader.structure.sensor_uid.tolist() == [*range(1000, 1015)])
    assert "robot walle: no patch 'thumb'; there are: palm, wrist" in troubles(ends)


@pytest.mark.thorough
def test_another_part_under_the_same_name_is_never_seen_under_the_old_structure(net: Net, namespace: Namespace) -> None:
    """The region has other sensors of each generation; a value tells of which sensor it is."""
    wish = Wish(in_regions=("tips",), regions=(Region("tips", module=("palm, triangle 1",)),))
    with (
        joining(net, namespace, "push", wish=wish) as ends,
        serving(net, namespace),
        driver(namespace) as writer,
        ExitStack() as stack,
    ):
        until_here(ends, writer)
        reader = stack.enter_context(DriverReader("hand", namespace=ends.here, timeout_s=PATIENCE_S))
        for number in range(20):
            writer.restructure(hand(("palm", "wrist") if number % 2 else ("thumb", "palm", "wrist")))
            for _ in range(3):
                publish(writer)
            here_as(ends, writer, lambda here: here.structure.sensor_uid.tolist() == [5, 6, 7, 8, 9])
            if reader.structure_changed or not reader.alive:
                reader.close()
                reader = stack.enter_context(DriverReader("hand", namespace=ends.here, timeout_s=PATIENCE_S))
            frame = reader.read()
            assert (frame.values - frame.values[0]).tolist() == [0, 1, 2, 3, 4]


def test_the_bridge_of_the_robot_is_started_again(net: Net, namespace: Namespace) -> None:
    wish = Wish(patches=("wrist",))
    with joining(net, namespace, wish=wish) as ends, driver(namespace) as writer:
        for _ in range(2):
            with serving(net, namespace):
                until_here(ends, writer)
                here_as(ends, writer, lambda reader: bool(reader.alive) and reader.structure.n_sensors == 15)


def test_lost_is_that_of_the_robot(net: Net, namespace: Namespace) -> None:
    wish = Wish(patches=("palm",))
    with joining(net, namespace, "push", wish=wish) as ends, serving(net, namespace), driver(namespace) as writer:
        until_here(ends, writer)
        with DriverReader("hand", namespace=ends.here, timeout_s=PATIENCE_S) as reader:
            publish(writer)
            wait_until(lambda: int(reader.read().values[0]) == writer.sequence - 1)
            before = reader.missed
            net.loses = lambda kind, _key: kind == "frame"
            offered = net.offered
            for number in range(1, 8):
                publish(writer)
                wait_until(lambda number=number: net.offered >= offered + number)  # type: ignore[misc]
            net.loses = lambda _kind, _key: False
            publish(writer)
            wait_until(lambda: int(reader.read().values[0]) == writer.sequence - 1)
            assert reader.missed - before == 7


def test_operations_are_those_of_the_whole_driver(net: Net, namespace: Namespace) -> None:
    tared: list[str | None] = []

    def tare(patch: str | None = None) -> str:
        """Take the present load as none."""
        tared.append(patch)
        return f"{patch or 'all'} tared"

    wish, ended = Wish(patches=("thumb",)), threading.Event()
    with (
        joining(net, namespace, wish=wish) as ends,
        serving(net, namespace),
        driver(namespace, {"tare": tare}) as writer,
    ):

        def work() -> None:
            while not ended.is_set():
                publish(writer)
                writer.answer_requests(0.01)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            with DriverReader("hand", namespace=ends.here, timeout_s=PATIENCE_S) as reader:
                assert reader.operations()["tare"] == "Take the present load as none."
                assert reader.call("tare", patch="thumb", timeout_s=PATIENCE_S) == "thumb tared"
                assert reader.call("tare", timeout_s=PATIENCE_S) == "all tared"
        finally:
            ended.set()
            thread.join()
    assert tared == ["thumb", None]
