"""A chain of baselines, and the loads behind it, are in C those of their specification in numpy."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from skinware import DriverSnapshot, Status, Structure
from skinware.sensor_types import MAGNETIC_FIELD, PRESSURE
from skinware.tactile.baseline import Baseline
from skinware.tactile.chain import ChainSettings
from skinware.tactile.derived_services import Loads
from tests.specification.chain import Onsets, SpecifiedCalm, SpecifiedLoads
from tests.tactile.turning import Frame

TAXELS, MOST = 9, 60.0


def structure(names: int) -> Structure:
    """Taxels of one type, or of three, one after the other."""
    types = [PRESSURE] if names == 1 else MAGNETIC_FIELD
    measured = [each.measured(unit="uT", minimum=-MOST, maximum=MOST) for each in types]
    return Structure(
        types=measured,
        buses=["can0"],
        patch_name=["left", "right"],
        patch_bus=[0, 0],
        module_patch=[0, 1],
        module_kind=["x"] * 2,
        sensor_uid=np.repeat(np.arange(TAXELS), len(types)),
        sensor_type=[each.id for each in measured] * TAXELS,
        sensor_module=np.repeat([0, 1], [4 * len(types), 5 * len(types)]),
        dtype="f4",
    )


@pytest.mark.parametrize("names", [1, 3])
def test_values_status_and_loads_are_those_of_the_specification(names: int) -> None:
    skin, random = structure(names), np.random.default_rng(names)
    types = [each.name for each in skin.types]
    chain = ChainSettings.calm().chain(skin)
    loads = Loads(chain, tuple(types))
    indexes = [skin.index(name) for name in types]
    specified = SpecifiedCalm([Baseline.of(skin, name) for name in types], indexes)
    wanted_loads = SpecifiedLoads(indexes, MOST, Onsets(TAXELS))
    values, status = np.zeros(skin.n_sensors, np.float32), np.zeros(skin.n_sensors, np.uint8)
    touched = clipped = onsets = 0
    for number in range(900):
        given = (10 + random.standard_normal(skin.n_sensors)).astype(np.float32)
        given[: 3 * names] += np.float32(60 * (number > 600 and number % 40 < 20))
        given[random.random(skin.n_sensors) < 0.01] = np.nan
        bits = random.choice([0, 0, 0, 0, 0, 0, Status.STALE, Status.SUSPECT], skin.n_sensors).astype(np.uint8)
        frame = Frame(skin, (number + 1) * 10_000_000, given, bits)
        chain.step(cast(DriverSnapshot, frame), values, status)
        wanted = specified.step(frame.acquired_ns, given, bits)
        np.testing.assert_array_equal(values, wanted[0])
        np.testing.assert_array_equal(status, wanted[1])
        loads.find()
        more: Any = loads.more
        found = loads.load, loads.touched, more["onset"], more["clipped"], more["uncertainty"], more["sigmas"]
        for ours, of_specification in zip(found, wanted_loads.find(specified, *wanted), strict=True):
            np.testing.assert_array_equal(ours, of_specification)
        touched, clipped = touched + int(loads.touched.sum()), clipped + int(more["clipped"].sum())
        onsets += int(more["onset"].sum())
    assert min(touched, clipped, onsets) > 100
