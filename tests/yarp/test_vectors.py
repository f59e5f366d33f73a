"""In which order a driver's sensors stand in a port's vector, and what their values become."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import Structure
from skinware.errors import ConfigurationError
from skinware.sensor_types import FORCE, PRESSURE
from skinware.status import Status
from skinware.tactile.regions import Region
from skinware.yarp.vectors import Vector, vectors_of
from skinware_drivers.can.roboskin_layout import SKIN_TYPES, skin_patch, triangle_module
from skinware_drivers.description import assemble
from skinware_drivers.streams.yarp import Triangles, YarpDriver, YarpOptions


def boards(*buses: tuple[int, ...]) -> Structure:
    """Boards with triangles 0 and 2, in this order."""
    described = [
        (
            f"can{number}",
            [skin_patch(board, [triangle_module(board, t, "triangle", (6, 10)) for t in (0, 2)], 4) for board in bus],
        )
        for number, bus in enumerate(buses)
    ]
    return assemble(described, SKIN_TYPES, np.uint8).structure


def whole(structure: Structure, vectors: dict[str, Vector]) -> dict[str, list[float]]:
    """The vectors of a frame in which each sensor has its index as value."""
    values = np.arange(structure.n_sensors, dtype=np.uint8)
    return {name: vector.of(values, np.zeros(len(values), np.uint8)).tolist() for name, vector in vectors.items()}


def test_boards_stand_as_on_the_robot() -> None:
    structure = boards((14, 13), (2,))
    (vector,) = vectors_of("arm", structure, "roboskin").values()
    assert vector.length == 3 * 192
    told = whole(structure, {"arm": vector})["arm"]
    # board 2 of the last bus comes first: its triangles 0 and 2, without the thermal channels 6 and 10
    expected = np.zeros(576)
    for position, first in ((0, 48), (192, 0), (384, 24)):
        for start, sensors in ((position, range(first, first + 12)), (position + 24, range(first + 12, first + 24))):
            for channel, sensor in enumerate(sensors):
                expected[start + channel] = 0 if channel in (6, 10) else 255 - sensor
    assert told == expected.tolist()


def test_a_port_for_each_region() -> None:
    structure = boards((14, 13))
    regions = (
        Region("hand", "pressure", ("arm",), patch=("board 14",)),
        Region("forearm", "pressure", patch=("board 13",)),
        Region("other", "pressure", ("leg",), patch=("board 13",)),
        Region("nothing", "pressure", patch=("board 1",)),
    )
    vectors = vectors_of("arm", structure, "roboskin", regions=regions)
    assert {name: vector.length for name, vector in vectors.items()} == {"hand": 192, "forearm": 192}
    told = whole(structure, vectors)
    assert (told["hand"][0], told["forearm"][0]) == (255, 255 - 24)


def ports(*lengths: int) -> Structure:
    buses = []
    for number, length in enumerate(lengths):
        driver = YarpDriver(YarpOptions())
        patches, _ = driver._of_places(length)
        buses.append((f"yarp://h:1/icub/skin/part{number}?silence_s=1", patches))
    return assemble(buses, driver.types, np.float32).structure


def test_ports_that_were_read_are_served_as_they_were() -> None:
    structure = ports(41, 192)
    vectors = vectors_of("icub", structure, "yarp")
    assert {name: vector.length for name, vector in vectors.items()} == {"part0": 41, "part1": 192}
    values = np.arange(233, dtype=np.float32)
    good = np.zeros(233, np.uint8)
    assert vectors["part0"].of(values, good).tolist() == list(range(41))
    assert vectors["part1"].of(values, good).tolist() == np.minimum(np.arange(41, 233), 255).tolist()


def test_ports_of_a_robots_files_keep_their_gaps() -> None:
    driver = YarpDriver(YarpOptions(length=192, triangles=(Triangles(14, 0, (0, 2)),)))
    patches, _ = driver._of_boards()
    structure = assemble([("virtual:yarp", patches)], driver.types, np.float32).structure
    vectors = vectors_of("hand", structure, "yarp")
    assert list(vectors) == ["hand"]
    (vector,) = vectors.values()
    assert vector.length == 192
    assert vector.places.tolist() == [p for p in (*range(12), *range(24, 36)) if p % 12 not in (6, 10)]


def test_values_become_0_to_255_and_what_is_not_good_0() -> None:
    structure = assemble(
        [("bus", YarpDriver(YarpOptions())._of_places(6)[0])],
        [PRESSURE.measured(unit="kPa", scale=0.5, offset=-1.0, minimum=-1.0, maximum=50.0)],
        np.float32,
    ).structure
    (vector,) = vectors_of("skin", structure, "other").values()
    values = np.array([2, 102, 52, 1000, -7, np.nan], np.float32)
    status = np.zeros(6, np.uint8)
    assert vector.of(values, status).tolist() == [0, 255, 127.5, 255, 0, 0]
    status[[1, 2]] = Status.STALE, Status.SUSPECT
    assert vector.of(values, status).tolist() == [0, 0, 0, 255, 0, 0]
    (half,) = vectors_of("skin", structure, "other", full_scale=100.0).values()
    assert half.of(values, np.zeros(6, np.uint8))[1] == 127.5


def test_what_cannot_be_served_says_why() -> None:
    structure = assemble(
        [("bus", YarpDriver(YarpOptions())._of_places(6)[0])], [PRESSURE.measured(unit="N"), *FORCE], np.float32
    ).structure
    with pytest.raises(ConfigurationError, match="give --full-scale"):
        vectors_of("skin", structure, "other")
    with pytest.raises(ConfigurationError, match="no sensors of the type 'heat'"):
        vectors_of("skin", structure, "other", type_name="heat")
