"""Places of all taxels: each its own, as the geometry says, or in its module's shape beside the others."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware import Structure
from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS, NominalHand
from skinware.sensor_types import (
    FORCE,
    FORCE_Z,
    MAGNETIC_FIELD,
    PRESSURE,
    PROXIMITY,
    SHEAR_X,
    SHEAR_Y,
    TEMPERATURE,
    SensorType,
)
from skinware.views.quantities import quantities_of, types_of
from skinware.views.scene import ASPECT, FLAT_PITCH_M, Scene
from skinware_drivers.can.allegro_v5 import AllegroV5Options, AllegroV5UdpDriver
from skinware_drivers.description import Module, Patch, Sensor, assemble, taxels
from skinware_drivers.hand import Grid, Hand
from tests.cli.fake_skin import fake_structure
from tests.tactile.skins import triangles

KINDS = ("triangle", "fingertip", "4x6", "palm", "", "1000000x1", "0x0")


def structure_of(modules: list[tuple[int, str, int]], types: tuple[SensorType, ...] = (PRESSURE,)) -> Structure:
    """Modules of a patch, a kind and so many taxels, each with a sensor of every type."""
    n_patches = max(patch for patch, _, _ in modules) + 1
    taxels = [module for module, (_, _, count) in enumerate(modules) for _ in range(count)]
    return Structure(
        types=types,
        buses=["can0"],
        patch_name=[f"board {patch}" for patch in range(n_patches)],
        patch_bus=[0] * n_patches,
        module_patch=[patch for patch, _, _ in modules],
        module_kind=[kind for _, kind, _ in modules],
        sensor_uid=np.repeat(np.arange(len(taxels)), len(types)),
        sensor_type=[t.id for t in types] * len(taxels),
        sensor_module=np.repeat(taxels, len(types)),
        dtype="i2",
    )


def scene_of(**structures: Structure) -> Scene:
    return Scene({name: (structure, quantities_of(structure)) for name, structure in structures.items()})


def apart(places: npt.NDArray[np.float32]) -> float:
    """The least distance between two of them."""
    away = np.linalg.norm(places[:, None] - places[None, :], axis=2)
    return float(away[~np.eye(len(places), dtype=bool)].min(initial=np.inf))


def beside_or_below(one: npt.NDArray[np.float32], other: npt.NDArray[np.float32]) -> bool:
    """Whether one's box is on the left of the other's, or above it."""
    return bool(other[:, 0].min() > one[:, 0].max() or other[:, 1].max() < one[:, 1].min())


modules = st.lists(st.tuples(st.integers(0, 3), st.sampled_from(KINDS), st.integers(1, 14)), min_size=1, max_size=9)


@pytest.mark.thorough
@given(modules, modules)
def test_no_two_lie_on_each_other(one: list[tuple[int, str, int]], other: list[tuple[int, str, int]]) -> None:
    scene = scene_of(a=structure_of(one), b=structure_of(other))
    placed = [scene.of(name, "pressure") for name in ("a", "b")]
    places = np.concatenate([found.position for found in placed])
    assert np.isfinite(places).all()
    assert apart(places) > 0.9 * FLAT_PITCH_M
    assert beside_or_below(placed[0].position, placed[1].position)
    for found in placed:
        assert not found.is_known
        assert np.array_equal(found.normal, [[0, 0, 1]] * len(found.normal))


@pytest.mark.parametrize(("patches", "per_patch"), [(1, 16), (4, 16), (12, 1), (5, 3)])
@pytest.mark.parametrize("drivers", [1, 2, 5, 9])
def test_what_is_laid_out_flat_has_the_shape_of_a_window(drivers: int, patches: int, per_patch: int) -> None:
    hand = structure_of([(patch, "4x6", 24) for patch in range(patches) for _ in range(per_patch)])
    scene = scene_of(**{f"hand {number}": hand for number in range(drivers)})
    hands = [scene.of(f"hand {number}", "pressure").position for number in range(drivers)]
    assert all(beside_or_below(hands[i], hands[j]) for i in range(drivers) for j in range(i + 1, drivers))
    width, height, _ = np.ptp(np.concatenate(hands), axis=0)
    assert 0.4 < width / height / ASPECT < 1 / 0.4  # so much of a window is filled at least: half, where two boxes are


def test_a_module_has_its_shape() -> None:
    scene = scene_of(a=structure_of([(0, "triangle", 10), (0, "4x6", 24)]))
    places = scene.of("a", "pressure").position
    corners = places[[8, 5, 1]]  # of a triangle
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    assert np.allclose(sides, 3 * FLAT_PITCH_M)
    grid = places[10:].reshape(4, 6, 3)
    assert np.allclose(np.diff(grid[..., 0], axis=1), FLAT_PITCH_M)
    assert np.allclose(np.diff(grid[..., 1], axis=0), -FLAT_PITCH_M)


def test_places_are_those_of_the_geometry_and_the_rest_is_beside() -> None:
    structure = fake_structure(1, 2)
    geometry = Geometry.unknown(["pressure"] * 20, structure.sensor_uid[structure.index("pressure")])
    geometry.position_m[:], geometry.normal[:], geometry.frame[:] = triangles(2, 10), (0, 1, 0), "arm"
    geometry.position_m[15:] = np.nan
    structure = structure.placed(geometry)
    placed = scene_of(a=structure).of("a", "pressure")
    assert placed.is_known
    assert np.allclose(placed.position[:15], geometry.position_m[:15])
    assert np.array_equal(placed.normal[:15], [[0, 1, 0]] * 15)
    assert np.isfinite(placed.position).all()
    assert placed.position[15:, 0].min() > placed.position[:15, 0].max()
    assert not scene_of(a=structure).of("a", "temperature").is_known


def test_frames_lie_beside_each_other_or_where_they_are_said_to_be() -> None:
    structures = {}
    for frame in ("arm", "chest"):
        structure = fake_structure(1, 2)
        geometry = Geometry.unknown(["pressure"] * 20, structure.sensor_uid[structure.index("pressure")])
        geometry.position_m[:], geometry.normal[:], geometry.frame[:] = triangles(2, 10), (0, 0, 1), frame
        structures[frame] = structure.placed(geometry)
    scene = scene_of(**structures)
    arm, chest = (scene.of(frame, "pressure").position for frame in structures)
    assert np.allclose(arm, triangles(2, 10))
    assert chest[:, 0].min() > arm[:, 0].max()
    turned = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], float)
    scene = Scene({name: (s, quantities_of(s)) for name, s in structures.items()}, {"chest": turned})
    x, y, z = triangles(2, 10).T
    assert np.allclose(scene.of("chest", "pressure").position, np.array([1 - y, 2 + x, 3 + z]).T)
    assert np.array_equal(scene.pose("chest", "chest"), turned)
    assert np.array_equal(scene.pose("chest", "nowhere"), np.eye(4))


def a_hand(
    side: Literal["right", "left"] = "right",
    frame: str | None = None,
    fingers: tuple[str, ...] = ("thumb", "middle"),
    rows: int = 10,
) -> Structure:
    """Fingers of ``rows`` x 4 taxels with their places."""
    structure = structure_of([(0, f"{rows}x4", 4 * rows)] * len(fingers))
    grid, uids = Grid(rows, 4), structure.sensor_uid.reshape(len(fingers), -1).tolist()
    places = [Hand(side).down(finger, [grid])[0] for finger in fingers]
    places = [replace(place, frame=frame or place.frame) for place in places]
    parts = [grid.at(place, ["pressure"], uid) for place, uid in zip(places, uids, strict=True)]
    return structure.placed(Geometry.joined(parts))


@pytest.mark.parametrize("frame", [None, "palm"], ids=["nominal", "measured"])
def test_two_hands_lie_beside_each_other_in_their_order(frame: str | None) -> None:
    """In the nominal frame a right and a left one; in another frame two of one model, which have the same places."""
    hands = {"left": a_hand("right" if frame else "left", frame), "right": a_hand("right", frame)}
    scene = scene_of(**hands)
    left, right = (scene.of(name, "pressure").position for name in ("left", "right"))
    assert right[:, 0].min() - left[:, 0].max() > 0.1 * np.ptp(left[:, 0])
    assert np.allclose(np.ptp(left, axis=0), np.ptp(right, axis=0))
    other_way = scene_of(**dict(reversed(hands.items())))
    assert (
        other_way.of("left", "pressure").position[:, 0].min() > other_way.of("right", "pressure").position[:, 0].max()
    )
    geometry = hands["right"].geometry
    assert geometry is not None
    moved = geometry.position_m + scene.pose("right", frame or "right_hand_nominal")[:3, 3]  # as contacts are
    assert np.allclose(right, moved)
    assert np.array_equal(scene.pose("left", frame or "left_hand_nominal"), np.eye(4))


def test_hands_of_two_models_lie_beside_each_other() -> None:
    scene = scene_of(a=a_hand(), b=a_hand(rows=7))
    a, b = (scene.of(name, "pressure").position for name in "ab")
    assert b[:, 0].min() > a[:, 0].max()


def test_a_second_driver_of_a_frame_with_a_pose_is_turned_alike_and_beside() -> None:
    pose = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], float)
    hands = {name: (hand, quantities_of(hand)) for name in ("left", "right") for hand in [a_hand()]}
    scene = Scene(hands, {NominalHand().frame: pose})
    left, right = (scene.of(name, "pressure").position for name in ("left", "right"))
    assert np.array_equal(scene.pose("left", NominalHand().frame), pose)
    assert right[:, 0].min() > left[:, 0].max()
    assert np.allclose((right - left)[:, 1:], 0)


def test_drivers_of_two_parts_of_a_body_stay_together() -> None:
    scene = scene_of(**{finger: a_hand(frame="palm", fingers=(finger,)) for finger in FINGERS})
    assert all(np.array_equal(scene.pose(name, "palm"), np.eye(4)) for name in FINGERS)


def test_three_axes_are_one_picture() -> None:
    (force,) = quantities_of(structure_of([(0, "4x6", 24)], FORCE))
    assert (force.name, force.type.name) == ("force", "force_z")
    assert force.axes == ("force_x", "force_y")
    assert force.index.tolist() == list(range(2, 72, 3))
    assert force.shear.tolist() == [[at, at + 1] for at in range(0, 72, 3)]
    names = [quantity.name for quantity in quantities_of(structure_of([(0, "", 2)], (*MAGNETIC_FIELD, TEMPERATURE)))]
    assert names == ["magnetic_field", "temperature"]


def test_shear_belongs_to_pressure() -> None:
    (pressure,) = quantities_of(structure_of([(0, "", 2)], (SHEAR_X, SHEAR_Y, PRESSURE)))
    assert pressure.axes == ("shear_x", "shear_y")
    assert pressure.shear.tolist() == [[0, 1], [3, 4]]
    incomplete = structure_of([(0, "", 2)], (SHEAR_X, PRESSURE))
    assert [quantity.name for quantity in quantities_of(incomplete)] == ["pressure", "shear_x"]


@pytest.mark.parametrize(
    ("types", "names"),
    [
        ((SensorType("temperature_2", 99, "K"), PROXIMITY, PRESSURE), ["pressure", "proximity", "temperature_2"]),
        ((PRESSURE, FORCE_Z), ["force_z", "pressure"]),
        (FORCE, ["force_z", "force_x", "force_y"]),
    ],
)
def test_the_type_that_people_look_at_comes_first(types: tuple[SensorType, ...], names: list[str]) -> None:
    assert [t.name for t in types_of(structure_of([(0, "", 4)], types))] == names


def test_taxels_come_before_a_few_sums() -> None:
    modules = [Module(taxels(6), 0, "2x3"), Module([Sensor(FORCE_Z.name, 100)], 1)]
    structure = assemble([("bus", [Patch("finger", modules)])], (FORCE_Z, PRESSURE), np.uint16).structure
    assert [t.name for t in types_of(structure)] == ["pressure", "force_z"]


def test_a_module_across_fingers_is_a_pad_on_each() -> None:
    driver = AllegroV5UdpDriver(AllegroV5Options(side="left"))
    structure = assemble([("bus", driver.patches)], driver.types, driver.dtype).structure
    (pressure,) = quantities_of(structure.placed(driver.geometry or Geometry.joined([])))
    pads = pressure.pads
    assert pads.names == ["thumb", "index", "middle", "ring", "palm"]
    assert [pads.names[pad] for pad in pads.of_sensor.tolist()] == [
        "palm", *["thumb"] * 3, *["index"] * 4, *["middle"] * 4, *["ring"] * 4
    ]  # fmt: skip
    assert pads.is_on_hand.all()
    assert (pressure.total, pressure.has_loads) == ("highest", True)
    (plain,) = quantities_of(structure)  # without places
    assert plain.pads.names == ["hand"]
    assert not plain.pads.is_on_hand.any()


def test_two_hands_of_one_driver_lie_beside_each_other_with_their_outlines() -> None:
    structure, grid = structure_of([(0, "10x4", 40)] * 2), Grid(10, 4)
    first, second = structure.sensor_uid.reshape(2, -1).tolist()
    places_of = [Hand("right").down("index", [grid])[0], Hand("left").down("index", [grid])[0]]
    parts = [grid.at(place, ["pressure"], uid) for place, uid in zip(places_of, (first, second), strict=True)]
    scene = scene_of(both=structure.placed(Geometry.joined(parts)))
    places = scene.of("both", "pressure").position
    right, left = places[:40], places[40:]
    assert abs(right[:, 0].mean() - left[:, 0].mean()) > 0.09  # the width of a palm
    outlines = scene.outlines("both")
    assert len(outlines) == 4  # a finger and a palm of each
    assert np.concatenate(outlines)[:, 2].max() < places[:, 2].min()
    hands = sorted((np.concatenate(outlines[at : at + 2]) for at in (0, 2)), key=lambda at: at[:, 0].min())
    taxels = sorted((left, right), key=lambda at: at[:, 0].min())
    assert hands[0][:, 0].max() < hands[1][:, 0].min()
    for hand, at in zip(hands, taxels, strict=True):
        assert (hand.min(axis=0) < at.min(axis=0)).all()
        assert (hand.max(axis=0)[:2] > at.max(axis=0)[:2]).all()
