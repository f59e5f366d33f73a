"""Contacts that are found, measured and listed in C are those of their specification in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.geometry import Geometry
from skinware.tactile.contacts import COLUMNS, Contacts
from skinware.tactile.neighbours import neighbours
from tests.specification.contacts import SpecifiedContacts
from tests.tactile.skins import placed, triangles


def skin(kind: str) -> Geometry:
    """Two frames; of ``some``, a few places are not known."""
    geometry = placed(triangles(40, 60) if kind == "many" else triangles(20, 20))
    geometry.frame[: len(geometry) // 2] = "palm"
    geometry.normal[:] = [0.0, 0.6, 0.8]
    if kind == "some":
        geometry.position_m[::7] = np.nan
    return geometry


@pytest.mark.parametrize(("kind", "unit"), [("all", "Pa"), ("some", "N"), ("many", "counts")])
def test_contacts_are_those_of_the_specification(kind: str, unit: str) -> None:
    """Bells that come, wander, meet and go, with noise of single taxels; ``many``: more than are listed."""
    geometry, random = skin(kind), np.random.default_rng(len(kind))
    table, n = neighbours(geometry), len(geometry)
    module = np.arange(n) // 12
    ours = Contacts(n, table, geometry, module=module, unit=unit)
    specified = SpecifiedContacts(n, table, geometry, module, unit)
    place = np.nan_to_num(geometry.position_m)
    most = beyond = slips = 0
    for number in range(250 if kind != "many" else 40):
        sigmas = random.standard_normal(n)
        for bell in range(4):
            if (number + 60 * bell) % 240 < 150:
                middle = place[(37 * bell + 150) % n] + np.array([0.0004, 0.0002 * bell, 0]) * (number % 60)
                sigmas += (40 + 20 * bell) * np.exp(-((place - middle) ** 2).sum(axis=1) / (2 * 0.006**2))
        if kind == "many":
            sigmas[random.random(n) < 0.05] += 8
        sigmas[random.random(n) < 0.01] = np.nan
        touched, onset = sigmas > 6, (sigmas > 4) & (random.random(n) < 0.5)
        value, clipped = np.where(touched, sigmas, 0).astype(np.float32), sigmas > 50
        uncertainty, time_ns = random.random(n).astype(np.float32), (number + 1) * 10_000_000
        found = ours.update(
            value, touched, time_ns, onset=onset, clipped=clipped, uncertainty=uncertainty, sigmas=sigmas
        )
        columns, contact_of, left = specified.update(value, touched, time_ns, onset, clipped, uncertainty, sigmas)
        for name in COLUMNS:
            np.testing.assert_allclose(getattr(found, name), columns[name], 1e-6, 1e-12, err_msg=name)
        np.testing.assert_array_equal(found.contact_of, contact_of)
        assert found.beyond == left
        most, beyond, slips = max(most, len(found)), beyond + left, slips + int(found.slips.sum())
    assert most > 2
    assert slips
    assert (beyond > 0) == (kind == "many")
