"""A bus that knows where its sensors are, and that can do something itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from skinware import DriverReader
from skinware.errors import RequestFailed, RequestRefused
from skinware.geometry import Geometry
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.description import SkinTables, assemble
from skinware_drivers.running.building import put_in_place
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual.bus import PlacedCanBus, VirtualCanBus
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions as EmulatorOptions

pytestmark = pytest.mark.usefixtures("hurry")

AT = [0.07, 0.0225, 0.0]


def on_arm(board: int, *, listen_only: bool = False) -> VirtualCanBus:
    options = EmulatorOptions(boards=(board,), pattern="idle", streaming=listen_only)
    return PlacedCanBus("", hardware=EmulatedRoboskin(options), listen_only=listen_only)


def nowhere(board: int) -> VirtualCanBus:
    return VirtualCanBus("", hardware=EmulatedRoboskin(EmulatorOptions(boards=(board,), pattern="idle")))


def driver(*boards: int) -> RoboskinDriver:
    return RoboskinDriver(RoboskinOptions(boards=boards))


def tables(*buses: Sequence[int]) -> SkinTables:
    adapters = [driver(*boards) for boards in buses]
    patches = [adapter.patches_set_up(boards) for adapter, boards in zip(adapters, buses, strict=True)]
    return assemble([(f"can{n}", found) for n, found in enumerate(patches)], adapters[0].types, np.uint8)


def test_places_of_a_bus_are_published_and_each_bus_has_its_own_frame() -> None:
    lines = [(driver(7), on_arm(7)), (driver(9), nowhere(9)), (driver(8), on_arm(8))]
    with driving_lines(lines, "arms"), DriverReader("arms") as reader:
        geometry = reader.structure.geometry
        assert geometry is not None
        of_bus = reader.structure.patch_bus[reader.structure.sensor_patch]
        assert geometry.known.tolist() == (of_bus != 1).tolist()
        assert set(geometry.frame[of_bus == 0]) == {"arm"}
        assert set(geometry.frame[of_bus == 2]) == {"arm 3"}


def test_what_a_person_gave_comes_first_and_places_of_other_sensors_are_none() -> None:
    here, there = tables([7]), tables([8])
    of_bus = EmulatedRoboskin(EmulatorOptions(boards=(7,))).geometry()
    assert put_in_place(here, None, [None]) is here
    assert put_in_place(there, None, [of_bus]) is there
    placed = put_in_place(here, None, [of_bus]).structure.geometry
    assert placed is not None
    assert placed.known.all()
    given = Geometry.joined([of_bus[:5]])
    by_hand = put_in_place(here, given, [of_bus]).structure.geometry
    assert by_hand is not None
    assert by_hand.known.sum() == 5


def test_a_driver_knows_places_where_its_bus_knows_none() -> None:
    class Known(RoboskinDriver):
        geometry = EmulatedRoboskin(EmulatorOptions(boards=(9,))).geometry()[:4]

    def known(board: int) -> Known:
        return Known(RoboskinOptions(boards=(board,)))

    lines = [(known(9), nowhere(9)), (known(9), on_arm(9)), (known(8), nowhere(8))]
    with driving_lines(lines, "arms"), DriverReader("arms") as reader:
        geometry = reader.structure.geometry
        assert geometry is not None
        of_bus = reader.structure.patch_bus[reader.structure.sensor_patch]
        assert [int(geometry.known[of_bus == bus].sum()) for bus in range(3)] == [4, int((of_bus == 1).sum()), 0]


def test_foreign_places_that_a_person_gave_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    put_in_place(tables([8]), EmulatedRoboskin(EmulatorOptions(boards=(7,))).geometry(), [None])
    assert "no place for any of the sensors" in caplog.text


def test_only_the_buses_that_can_are_asked() -> None:
    lines = [(driver(7), on_arm(7)), (driver(9), nowhere(9)), (driver(8), on_arm(8))]
    with driving_lines(lines, "arms"), DriverReader("arms") as reader:
        assert {"press", "rebaseline"} <= reader.operations().keys()
        at = EmulatedRoboskin(EmulatorOptions(boards=(7,))).geometry().position_m[0].tolist()
        assert reader.call("press", at_m=at, bus="bus0", seconds=30) == {
            "bus0": {"board": 7, "triangle": 0, "channel": 0, "distance_m": 0}
        }
        with pytest.raises(
            RequestRefused, match=r"no bus 'bus1' with patches; did you mean 'bus2'[?] There are: bus0, bus2"
        ):
            reader.call("press", at_m=at, bus="bus1")
        with pytest.raises(RequestFailed, match="bus0: no taxel is there"):
            reader.call("press", at_m=[0.07, -0.0225, 0.0])
        with pytest.raises(RequestRefused, match="it takes: bus, patch, at_m"):
            reader.call("press")
        with pytest.raises(RequestFailed, match="give x, y and z"):
            reader.call("press", at_m=[1])
        read_until(reader, lambda frame: frame.physical("pressure")[0] > 60)


def test_a_bus_that_only_listens_can_still_be_pressed() -> None:
    options = RoboskinOptions()
    with (
        driving_lines([(RoboskinDriver(options), on_arm(7, listen_only=True))], "arm", listen_only=True),
        DriverReader("arm") as reader,
    ):
        reader.call("press", at_m=AT)
        with pytest.raises(RequestRefused, match="this driver only listens"):
            reader.call("rebaseline")


def test_a_bus_without_places_offers_nothing() -> None:
    with driving_lines([(driver(7), nowhere(7))], "plain"), DriverReader("plain") as reader:
        assert "press" not in reader.operations()
        assert reader.structure.geometry is None
