"""What contacts measure, on skins with places and without."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.errors import ConfigurationError
from skinware.tactile.contacts import BEYOND, MOST, NO_CONTACT, Contacts
from skinware.tactile.neighbours import neighbours, neighbours_of_pairs
from tests.tactile.skins import AT_ONCE, PITCH_M, placed, pressed, triangles
from tests.tactile.test_components import by_search

FLAT = triangles(60, 60)
UP = np.tile([0.0, 0.0, 1.0], (len(FLAT), 1))


def on_flat(unit: str = "counts") -> Contacts:
    geometry = placed(FLAT, normal=UP)
    return Contacts(len(FLAT), neighbours(geometry), geometry, unit=unit, tracking=AT_ONCE)


def test_twenty_disjoint_blobs_are_found_exactly() -> None:
    at_m = np.array([[x, y, 0] for x in np.linspace(0.04, 0.36, 5) for y in np.linspace(0.03, 0.3, 4)])
    at_m[:, :2] += np.random.default_rng(3).uniform(-0.005, 0.005, (20, 2))
    value = pressed(FLAT, at_m, 0.022)
    found = on_flat().update(value, value > 1, 0)
    assert len(found) == 20
    owner = np.linalg.norm(FLAT[:, None] - at_m, axis=2).argmin(axis=1)
    expected = {frozenset(np.flatnonzero((value > 1) & (owner == blob)).tolist()) for blob in range(20)}
    assert {frozenset(contact.taxels.tolist()) for contact in found} == expected
    for contact in found:
        assert np.linalg.norm(at_m - contact.cop_m, axis=1).min() < 0.001
        assert contact.n == len(contact.taxels)
        assert (found.contact_of[contact.taxels] == found.contact_of[contact.taxels[0]]).all()
        assert contact.load == pytest.approx(value[contact.taxels].sum())
        assert contact.peak == pytest.approx(value[contact.taxels].max())
    assert (found.contact_of[value <= 1] == NO_CONTACT).all()


@given(st.data(), st.integers(1, 40))
def test_any_pattern_on_any_graph_as_by_search(data: st.DataObject, n: int) -> None:
    number = st.integers(0, n - 1)
    table = neighbours_of_pairs(data.draw(st.lists(st.tuples(number, number), max_size=2 * n)), n)
    contacts = Contacts(n, table, tracking=AT_ONCE)
    for time_ns in range(0, 100_000_000, 20_000_000):
        touched = np.zeros(n, bool)
        touched[list(data.draw(st.sets(number)))] = True
        found = contacts.update(np.ones(n), touched, time_ns)
        blobs = by_search(table, set(np.flatnonzero(touched).tolist()))
        assert {frozenset(contact.taxels.tolist()) for contact in found} == blobs
        assert len(set(found.id.tolist())) == len(found)
        assert not (found.id == 0).any()


def test_more_than_there_is_room_for_keeps_the_largest() -> None:
    n = MOST + 10
    value = np.random.default_rng(1).permutation(n) + 1.0
    found = Contacts(n, tracking=AT_ONCE).update(value, np.ones(n, bool), 0)
    assert (len(found), found.beyond) == (MOST, 10)
    assert found.load.min() == 11
    assert (found.contact_of[value <= 10] == BEYOND).all()
    assert (found.contact_of[value > 10] >= 0).all()


def test_the_centre_is_weighted_and_lies_in_the_frame_of_the_peak() -> None:
    geometry = placed(
        [[0.0, 0.0, 0.0], [0.004, 0.0, 0.0], [9.0, 9.0, 9.0], [np.nan] * 3],
        ["b", "b", "a", "b"],
        normal=[[1, 0, 0]] * 2 + [[0, 1, 0]] * 2,
    )
    table = neighbours_of_pairs([(0, 1), (1, 2), (2, 3)], 4)
    contacts = Contacts(4, table, geometry, tracking=AT_ONCE)
    (contact,) = contacts.update(np.array([1.0, 3.0, 2.0, 50.0]), np.ones(4, bool), 0)
    assert contact.frame == "b"
    assert contact.cop_m.tolist() == pytest.approx([0.003, 0, 0])
    assert contact.normal.tolist() == [1, 0, 0]
    assert (contact.load, contact.peak, contact.n) == (56, 50, 4)
    (contact,) = contacts.update(np.array([1.0, 3.0, 5.0, 0.0]), np.ones(4, bool), 20_000_000)
    assert contact.frame == "a"
    assert contact.cop_m.tolist() == [9, 9, 9]


def test_the_normal_has_the_length_1_or_is_not_known() -> None:
    geometry = placed(triangles(1, 3), normal=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [np.nan] * 3])
    contacts = Contacts(3, neighbours_of_pairs([(0, 1), (1, 2)], 3), geometry, tracking=AT_ONCE)
    (contact,) = contacts.update(np.ones(3), np.ones(3, bool), 0)
    assert contact.normal.tolist() == pytest.approx([np.sqrt(0.5), np.sqrt(0.5), 0])
    (contact,) = contacts.update(np.ones(3), np.array([False, False, True]), 0)
    assert np.isnan(contact.normal).all()


@pytest.mark.parametrize(("unit", "is_told"), [("Pa", True), ("counts", False), ("", False)])
def test_a_force_is_told_where_the_values_are_pressures(unit: str, is_told: bool) -> None:
    value = pressed(FLAT, [0.2, 0.15, 0], 0.02, load=1000.0)
    (contact,) = on_flat(unit).update(value, value > 0, 0)
    cell_m2 = PITCH_M**2 * np.sqrt(0.75)
    assert contact.area_m2 == pytest.approx(contact.n * cell_m2)
    if is_told:
        assert contact.force_n == pytest.approx(value.sum() * cell_m2)
        assert contact.force_n == pytest.approx(1000 * np.pi * 0.02**2 / 3, rel=0.03)  # of the cone itself
    else:
        assert np.isnan(contact.force_n)


def test_without_places_there_is_still_a_load() -> None:
    contacts = Contacts(4, neighbours_of_pairs([(0, 1)], 4), unit="Pa", tracking=AT_ONCE)
    found = contacts.update(np.array([1, 2, 3, 4.0]), np.array([1, 1, 0, 1], bool), 0)
    assert [(contact.load, contact.frame) for contact in found] == [(3, ""), (4, "")]
    for name in ("cop_m", "normal", "velocity_m_s", "area_m2", "force_n"):
        assert np.isnan(getattr(found, name)).all()
    again = contacts.update(np.array([1, 2, 3, 4.0]), np.array([1, 0, 0, 1], bool), 20_000_000)
    assert again.id.tolist() == found.id.tolist()


def test_values_that_are_none_count_as_0() -> None:
    geometry = placed(triangles(1, 4))
    contacts = Contacts(4, neighbours(geometry), geometry, tracking=AT_ONCE)
    (contact,) = contacts.update(np.array([np.nan, -5, np.inf, 2]), np.ones(4, bool), 0)
    assert (contact.load, contact.peak, contact.n) == (2, 2, 4)
    assert contact.cop_m.tolist() == pytest.approx([3 * PITCH_M, 0, 0])
    (contact,) = contacts.update(np.full(4, np.nan), np.ones(4, bool), 0)
    assert contact.load == 0
    assert contact.cop_m.tolist() == pytest.approx([1.5 * PITCH_M, 0, 0])


@pytest.mark.parametrize("dtype", ["u1", "<i2", "<f4", "<f8"])
def test_values_of_any_dtype(dtype: str) -> None:
    (contact,) = Contacts(2, neighbours_of_pairs([(0, 1)], 2), tracking=AT_ONCE).update(
        np.array([200, 100]).astype(dtype), np.ones(2, bool), 0
    )
    assert contact.load == np.array([200, 100]).astype(dtype).astype(float).clip(0).sum()


def test_nothing_touched_and_no_taxels() -> None:
    assert len(on_flat().update(np.zeros(len(FLAT)), np.zeros(len(FLAT), bool), 0)) == 0
    assert len(Contacts(0).update(np.zeros(0), np.zeros(0, bool), 0)) == 0


def test_what_is_not_of_these_taxels_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="the places are of 3"):
        Contacts(4, geometry=placed(triangles(1, 3)))
    with pytest.raises(ConfigurationError, match="the modules are of 3"):
        Contacts(4, module=np.zeros(3))
    with pytest.raises(ConfigurationError, match=r"contacts of 4 taxels: values of \(3,\)"):
        Contacts(4).update(np.zeros(3), np.zeros(4, bool), 0)


def test_a_row_is_a_contact() -> None:
    value: npt.NDArray[np.float64] = np.array([1.0, 0, 2, 0, 3])
    found = Contacts(5, tracking=AT_ONCE).update(value, value > 0, 0)
    assert found[-1].id == found[2].id == found.id[2]
    assert [contact.taxels.tolist() for contact in found] == [[0], [2], [4]]
    with pytest.raises(IndexError):
        found[3]


def test_a_contact_in_the_list_stays_unless_another_is_clearly_larger() -> None:
    n = MOST + 5
    contacts, value = Contacts(n, tracking=AT_ONCE), np.full(n, 10.0)
    first = contacts.update(value, np.arange(n) < MOST, 0)
    value[MOST:] = 14.0
    kept = contacts.update(value, np.ones(n, bool), 20_000_000)
    assert kept.id.tolist() == first.id.tolist()
    assert (kept.contact_of[MOST:] == BEYOND).all()
    value[MOST] = 16.0
    assert contacts.update(value, np.ones(n, bool), 40_000_000).contact_of[MOST] >= 0


def test_a_spike_of_one_frame_is_no_contact() -> None:
    contacts, value = Contacts(3), np.array([0.0, 200, 0])
    assert len(contacts.update(value, value > 0, 0)) == 0
    assert len(contacts.update(0 * value, value > 200, 20_000_000)) == 0
    assert [len(contacts.update(value, value > 0, time_ns)) for time_ns in (200_000_000, 220_000_000)] == [0, 1]


def listed_ms(load: float) -> list[int]:
    """When a contact with an uncertainty of 2 is listed, of half a second with gaps of a frame, ms."""
    contacts, found = Contacts(2, neighbours_of_pairs([[0, 1]], 2)), []
    for time_ms in range(0, 500, 20):
        value = np.full(2, load * (time_ms % 60 > 0))
        if len(contacts.update(value, value > 0, time_ms * 1_000_000, uncertainty=np.full(2, 2.0))):
            found.append(time_ms)
    return found


def test_values_within_their_uncertainty_are_a_contact_only_if_they_last() -> None:
    """A load that flickers as a touch ends is no contact; a faint load that is held is one."""
    assert min(listed_ms(8.0)) == 40
    assert min(listed_ms(7.9)) == 320


@pytest.mark.parametrize(("peak", "most"), [(20.0, np.inf), (60.0, np.inf), (60.0, 40.0), (60.0, 25.0)])
def test_what_threshold_and_clipping_cut_off_is_estimated(peak: float, most: float) -> None:
    squares = ((FLAT - FLAT[30 * 60 + 30] - [0.001, 0.002, 0]) ** 2).sum(axis=1)
    whole = peak * np.exp(-squares / (2 * (2 * PITCH_M) ** 2))
    value = np.where(whole > 4, np.minimum(whole, most), 0.0)
    (contact,) = on_flat().update(value, value > 0, 0, clipped=value >= most, uncertainty=np.full(len(FLAT), 0.5))
    assert contact.clipped == np.count_nonzero(value >= most)
    assert contact.uncertainty == contact.n / 2
    assert contact.load < 0.95 * whole.sum()
    assert contact.load_whole == pytest.approx(whole.sum(), rel=0.1)


def test_what_is_mostly_cut_off_is_not_estimated() -> None:
    value = np.array([4.0, 4.5, 4.0])
    chain = neighbours_of_pairs([(0, 1), (1, 2)], 3)
    (contact,) = Contacts(3, chain, tracking=AT_ONCE).update(value, value > 0, 0)
    assert np.isnan(contact.load_whole)
    (contact,) = Contacts(3, chain, tracking=AT_ONCE).update(value, value > 0, 0, clipped=value > 0)
    assert np.isnan(contact.load_whole)
