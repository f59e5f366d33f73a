"""Contacts in the forms of other middlewares."""

from __future__ import annotations

import json

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile import Contacts
from skinware.tactile.contacts import ContactSet
from skinware.tactile.exports import IcubPart, icub_contacts, tactile_msgs_contacts
from skinware.tactile.neighbours import neighbours
from tests.tactile.skins import AT_ONCE, placed, triangles

PLACES = placed(triangles(10, 10), normal=(0, 0, 1))
PART = IcubPart(body_part=3, link=4, skin_part=5)


def found(value: dict[int, float], unit: str = "counts") -> ContactSet:
    values = np.zeros(100)
    values[list(value)] = list(value.values())
    contacts = Contacts(100, neighbours(PLACES), PLACES, unit=unit, tracking=AT_ONCE)
    return contacts.update(values, values > 0, 1)


def test_an_icub_gets_its_lists() -> None:
    one, other = icub_contacts(found({44: 10.0, 45: 30.0, 0: 11.258}), PLACES, PART)
    assert [one[0], other[0]] == [[1, 3, 4, 5], [2, 3, 4, 5]]
    assert [len(part) for part in one[1:6]] == [3] * 5
    assert other[6] == [44, 45]
    assert other[7] == 20
    assert np.allclose(other[1], np.average(PLACES.position_m[[44, 45]], axis=0, weights=[1, 3]))
    assert np.allclose(other[4], PLACES.position_m[[44, 45]].mean(axis=0))
    assert np.allclose(one[2], [0, 0, -0.5629])  # as one of its logs has it for 11.258 counts of a single taxel
    assert one[3] == [0, 0, 0]
    assert json.loads(json.dumps([one, other])) == [one, other]


def test_ros_gets_the_fields_of_tactile_contact() -> None:
    (contact,) = tactile_msgs_contacts(found({44: 2000.0}, unit="Pa"), 12_000_000_034)
    assert contact["header"] == {"stamp": {"sec": 12, "nanosec": 34}, "frame_id": "chest"}
    assert contact["name"] == "1"
    x, y, _ = PLACES.position_m[44].tolist()
    assert contact["position"] == pytest.approx({"x": x, "y": y, "z": 0})
    assert contact["normal"] == {"x": 0, "y": 0, "z": 1}
    force, torque = contact["wrench"]["force"], contact["wrench"]["torque"]
    assert force["z"] < 0
    assert torque == pytest.approx({"x": y * force["z"], "y": -x * force["z"], "z": 0})


def test_a_force_that_nobody_knows_is_not_invented() -> None:
    counts = found({44: 10.0})
    (unknown,) = tactile_msgs_contacts(counts, 0)
    assert np.isnan(unknown["wrench"]["force"]["z"])
    (known,) = tactile_msgs_contacts(counts, 0, newtons_per_load=0.2)
    assert known["wrench"]["force"]["z"] == pytest.approx(-2)
    (pressed,) = icub_contacts(found({44: 2000.0}, unit="Pa"), PLACES, PART)
    assert pressed[2][2] > -1, "the pressure counts, and not what counts are worth"
    assert tactile_msgs_contacts(found({}), 0) == []
    with pytest.raises(ConfigurationError, match="contacts of 100 taxels: the places are of 99"):
        icub_contacts(counts, PLACES[np.arange(99)], PART)
