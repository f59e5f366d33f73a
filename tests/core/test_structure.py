from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware import Structure
from skinware.errors import StructureError
from skinware.sensor_types import PRESSURE, TEMPERATURE, SensorType

COUNTS = PRESSURE.measured(unit="counts", scale=-1.0, offset=255.0)


def tables(**changes: Any) -> dict[str, Any]:
    return {
        "types": [COUNTS, TEMPERATURE],
        "buses": ["vcan0"],
        "patch_name": ["board 7"],
        "patch_bus": [0],
        "module_patch": [0, 0],
        "module_kind": ["triangle", "palm"],
        "sensor_uid": [10, 11, 12, 10],
        "sensor_type": [1, 1, 5, 5],
        "sensor_module": [0, 0, 1, 1],
        "dtype": "u1",
        **changes,
    }


@pytest.mark.thorough
@given(
    modules=st.lists(st.integers(0, 3), min_size=1, max_size=6),
    sensors=st.lists(st.tuples(st.booleans(), st.integers(0, 2**64 - 1)), min_size=1, max_size=40, unique=True),
    data=st.data(),
)
def test_columns_round_trip_and_indices_agree(
    modules: list[int], sensors: list[tuple[bool, int]], data: st.DataObject
) -> None:
    owner = [data.draw(st.integers(0, len(modules) - 1)) for _ in sensors]
    made = Structure(
        types=[COUNTS, TEMPERATURE],
        buses=["a", "b"],
        patch_name=["p", "q", "r", "s"],
        patch_bus=[0, 1, 0, 1],
        module_patch=modules,
        module_kind=[""] * len(modules),
        sensor_uid=np.array([uid for _, uid in sensors], np.uint64),
        sensor_type=[1 if is_pressure else 5 for is_pressure, _ in sensors],
        sensor_module=owner,
        dtype="<i4",
    )
    assert Structure.from_columns(made.to_columns(), made.dtype) == made
    everything = np.arange(made.n_sensors)
    for name, code in (("pressure", 1), ("temperature", 5)):
        assert everything[made.index(name)].tolist() == [i for i in everything if made.sensor_type[i] == code]
    for module in range(made.n_modules):
        assert everything[made.module_index(module)].tolist() == [i for i in everything if owner[i] == module]
    for patch in range(made.n_patches):
        assert everything[made.patch_index(patch)].tolist() == [i for i in everything if modules[owner[i]] == patch]
    for position, (is_pressure, uid) in enumerate(sensors):
        assert made.position("pressure" if is_pressure else "temperature", uid) == position


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensor_uid": [10, 10, 12, 10]}, "sensor 1: uid 0xa appears twice"),
        ({"sensor_type": [1, 1, 5, 7]}, "sensor 3 has type 7"),
        ({"sensor_module": [0, 0, 1, 2]}, "sensor 3 belongs to module 2, but there are only 2"),
        ({"module_patch": [0, 1]}, "module 1 belongs to patch 1"),
        ({"patch_bus": [3]}, "patch 0 belongs to bus 3"),
        ({"sensor_type": [1, 1, 5]}, "different lengths"),
        ({"dtype": "f8"}, "values of dtype float64"),
        ({"sensor_uid": [-1, 11, 12, 10]}, "sensor_uid has a value outside"),
        ({"module_kind": ["x" * 17, ""]}, "module_kind 0 is longer than 16 bytes"),
        ({"sensor_uid": [], "sensor_type": [], "sensor_module": []}, "at least one sensor"),
        ({"types": [COUNTS, COUNTS, TEMPERATURE]}, "share a name"),
    ],
)
def test_contradictions_are_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(StructureError, match=words):
        Structure(**tables(**changes))


def test_physical_values_use_scale_and_offset() -> None:
    structure = Structure(**tables())
    raw = np.array([240, 0, 7, 9], np.uint8)
    assert structure.physical(raw, "pressure").tolist() == [15.0, 255.0]
    assert structure.physical(raw, "temperature").tolist() == [7.0, 9.0]
    both = structure.physical_values(np.stack([raw, raw]))
    for name in ("pressure", "temperature"):
        assert both[:, structure.index(name)].tolist() == 2 * [structure.physical(raw, name).tolist()]
    with pytest.raises(StructureError, match="there are: pressure, temperature"):
        structure.physical(raw, "shear_x")


def test_some_of_the_sensors_keep_what_they_belong_to() -> None:
    whole = Structure(**tables())
    for positions in (slice(1, 3), np.array([0, 3]), np.array([2])):
        some = whole.only(positions)
        assert some.sensor_uid.tolist() == whole.sensor_uid[positions].tolist()
        assert some.sensor_type.tolist() == whole.sensor_type[positions].tolist()
        assert some.sensor_module.tolist() == whole.sensor_module[positions].tolist()
        assert (some.n_patches, some.n_modules, some.types) == (whole.n_patches, whole.n_modules, whole.types)
    with pytest.raises(StructureError, match="at least one sensor"):
        whole.only(slice(0))


def test_tables_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        Structure(**tables()).sensor_uid[0] = 1


@pytest.mark.parametrize("wrong", [{"name": ""}, {"id": 0}, {"scale": 0.0}, {"unit": "u" * 17}])
def test_bad_sensor_types_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(StructureError):
        SensorType(**{"name": "pressure", "id": 1, "unit": "Pa", **wrong})
