"""What kind of module a triangle is, and which of its channels feel no touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skinware import Structure
from skinware_drivers.can.roboskin_layout import Kind, RoboskinOptions
from skinware_drivers.can.roboskin_setup import BoardSetUp, warn_of_uneven_triangles
from tests.sdk.test_roboskin_wire import Rig


def structure_of(boards: tuple[int, ...] = (7,), n_buses: int = 1, **options: object) -> Structure:
    return Rig(boards=boards, n_buses=n_buses, **options).decoder.tables.structure


def non_tactile(structure: Structure) -> set[int]:
    """Channels that are of type temperature."""
    return {int(uid) & 0xFF for uid in structure.sensor_uid[structure.index("temperature")]}


@pytest.mark.parametrize(
    ("skin_type", "kind", "channels"),
    [
        (0, b"triangle", {6, 10}),
        (2, b"triangle", {6, 10}),
        (8, b"triangle", {6, 10}),
        (1, b"fingertip", set()),
        (7, b"fingertip", set()),
    ],
)
def test_the_type_of_skin_tells_what_the_modules_are(skin_type: int, kind: bytes, channels: set[int]) -> None:
    structure = structure_of(skin_type=skin_type)
    assert set(structure.module_kind.tolist()) == {kind}
    assert non_tactile(structure) == channels


def test_the_ergocub_hand_has_five_fingertips_and_triangles_with_thermal_pads() -> None:
    structure = structure_of(skin_type=3)
    assert structure.module_kind.tolist() == [b"fingertip"] * 5 + [b"triangle"] * 11
    thermal = structure.sensor_uid[structure.index("temperature")]
    assert {(int(uid) >> 8 & 0xFF, int(uid) & 0xFF) for uid in thermal} == {
        (t, k) for t in range(5, 16) for k in (6, 10)
    }


@pytest.mark.parametrize(("uneven", "warned"), [({}, False), ({"shift": 3}, True), ({"cdc_offset": 0x2300}, True)])
def test_different_shifts_on_a_hand_of_type_3_are_warned_of(uneven: Any, warned: bool, caplog: Any) -> None:
    modules = (Kind(board=7, triangles=(8,), **uneven),) if uneven else ()
    for skin_type in (0, 3):
        options = RoboskinOptions(boards=(7,), skin_type=skin_type, modules=modules)
        warn_of_uneven_triangles("can0", [BoardSetUp(options, 7)])
    assert ("skin type 3 takes them as meant at its first set-up only" in caplog.text) == warned
    assert caplog.text.count("board 7") == int(warned)


@pytest.mark.parametrize(("kind", "channels"), [("triangle", {6, 10}), ("fingertip", set()), ("palm", {11})])
def test_the_user_knows_better(kind: str, channels: set[int]) -> None:
    structure = structure_of(skin_type=1, kind=kind)
    assert set(structure.module_kind.tolist()) == {kind.encode()}
    assert non_tactile(structure) == channels


def test_types_share_no_sensor_and_leave_none_out() -> None:
    structure = structure_of(modules=(Kind(board=7, triangles=(2, 3), kind="palm"),))
    everything = np.arange(192)
    tactile, other = everything[structure.index("pressure")], everything[structure.index("temperature")]
    assert np.array_equal(np.sort(np.concatenate([tactile, other])), everything)
    assert len(other) == 14 * 2 + 2 * 1


def test_a_special_triangle_is_special_on_its_own_board_only() -> None:
    structure = structure_of(boards=(7, 8), modules=(Kind(board=8, triangles=(0,), kind="palm"),))
    assert structure.module_kind[[0, 16]].tolist() == [b"triangle", b"palm"]


def test_sensors_are_in_ascending_order_of_uid() -> None:
    special = (Kind(board=7, triangles=(2,), kind="palm"), Kind(board=9, triangles=(0, 5), enabled=False))
    structure = structure_of(boards=(7, 9), n_buses=2, modules=special)
    assert np.all(np.diff(structure.sensor_uid.astype(np.int64)) > 0)
    assert structure.sensor_uid[[0, 12]].tolist() == [7 << 16, 7 << 16 | 1 << 8]
    assert int(structure.sensor_uid[-1]) == 1 << 32 | 9 << 16 | 15 << 8 | 11
