"""Identities of contacts: through gaps, past each other, when they merge and split."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware.tactile.contacts import Contacts, ContactSet
from skinware.tactile.neighbours import neighbours
from skinware.tactile.tracking import ContactKind
from tests.tactile.skins import AT_ONCE, PITCH_M, placed, pressed, triangles

FLAT = triangles(30, 40)
NEIGHBOURS = neighbours(placed(FLAT))
NARROW_M = 0.62 * PITCH_M
"""A place touches one taxel or two; 3 pitches apart two places have no neighbours in common."""


class Scene:
    """Fingers on a flat skin, frame by frame."""

    def __init__(self, rate_hz: float = 50.0, *, without_places: bool = False) -> None:
        geometry = None if without_places else placed(FLAT)
        self.contacts = Contacts(len(FLAT), NEIGHBOURS, geometry, tracking=AT_ONCE)
        self.period_ns = round(1e9 / rate_hz)
        self.time_ns = 1_000_000_000

    def show(self, *at_m: npt.ArrayLike, radius_m: float = NARROW_M) -> ContactSet:
        """The contacts of fingers at these places."""
        self.time_ns += self.period_ns
        value = pressed(FLAT, np.array(at_m, float).reshape(-1, 3), radius_m)
        return self.contacts.update(value, value > 0, self.time_ns)


def identity_at(found: ContactSet, at_m: npt.ArrayLike) -> int:
    """Of the contact whose centre is at a place, to within a pitch."""
    away_m = np.linalg.norm(found.cop_m - np.array(at_m), axis=1)
    assert away_m.min() < PITCH_M
    return int(found.id[away_m.argmin()])


def beside(place_m: npt.NDArray[np.float64], x_m: float) -> npt.NDArray[np.float64]:
    moved_m: npt.NDArray[np.float64] = place_m + np.array([x_m, 0.0, 0.0])
    return moved_m


HERE, THERE = np.array([0.05, 0.05, 0.0]), np.array([0.15, 0.1, 0.0])


@pytest.mark.parametrize("rate_hz", [20, 50, 100, 500])
@pytest.mark.parametrize("without_places", [False, True])
def test_an_identity_lasts_through_60_ms(rate_hz: float, without_places: bool) -> None:
    scene = Scene(rate_hz, without_places=without_places)
    first = scene.show(HERE).id.tolist()
    for _ in range(round(0.06 * rate_hz)):
        assert len(scene.show()) == 0
    assert scene.show(HERE).id.tolist() == first
    for _ in range(round(0.06 * rate_hz) + 2):
        scene.show()
    assert scene.show(HERE).id.tolist() != first


def test_a_frame_that_comes_late_does_not_end_a_gap() -> None:
    scene = Scene()
    first = scene.show(HERE).id.tolist()
    for _ in range(3):
        scene.show()
    scene.time_ns += 5_000_000
    assert scene.show(HERE).id.tolist() == first


def test_it_may_move_on_in_a_gap() -> None:
    scene = Scene()
    velocity_m = np.array([0.004, 0, 0])  # in a frame
    for k in range(6):
        first = scene.show(HERE + k * velocity_m).id.tolist()
    for _ in range(3):
        scene.show()
    assert scene.show(HERE + 9 * velocity_m).id.tolist() == first


def test_age_begins_with_the_contact() -> None:
    scene = Scene()
    assert scene.show(HERE).age_s.tolist() == [0]
    scene.show(HERE)
    scene.show()
    assert scene.show(HERE, THERE).age_s.tolist() == pytest.approx([0.06, 0])


Lane = tuple[float, float, list[tuple[int, int]]]
"""Where a finger begins, m; its speed, m/s; and when it is away: first frames and numbers of frames."""


def lanes(fastest_m_s: float) -> st.SearchStrategy[list[Lane]]:
    gaps = st.lists(st.tuples(st.integers(8, 40), st.integers(1, 3)), max_size=2)
    speed = st.floats(-fastest_m_s, fastest_m_s)
    return st.lists(st.tuples(st.floats(0.05, 0.2), speed, gaps), min_size=2, max_size=5)


def identities(fingers: list[Lane]) -> Iterator[tuple[int, int, int]]:
    """Finger, frame and identity of each contact: fingers pass each other, in lanes 3 pitches apart."""
    scene = Scene()
    x, speed = np.array([[start, speed] for start, speed, _ in fingers]).T
    y = 0.02 + 3 * PITCH_M * np.arange(len(fingers))
    for frame in range(45):
        x = x + np.minimum(frame / 10, 1) * speed * 0.02  # it takes 0.2 s to get going
        speed = np.where(((x < 0.02) & (speed < 0)) | ((x > 0.23) & (speed > 0)), 0, speed)
        is_away = [any(first <= frame < first + length for first, length in gaps) for _, _, gaps in fingers]
        shown = np.flatnonzero(~np.array(is_away))
        at_m = np.column_stack([x, y, 0 * x])[shown]
        found = scene.show(at_m)
        assert len(found) == len(shown)
        for finger, place in zip(shown.tolist(), at_m, strict=True):
            yield finger, frame, identity_at(found, place)


@pytest.mark.thorough
@settings(max_examples=40)
@given(lanes(fastest_m_s=0.6))
def test_contacts_3_pitches_apart_are_never_swapped(fingers: list[Lane]) -> None:
    owner: dict[int, int] = {}
    newest: dict[int, tuple[int, int]] = {}
    for finger, frame, identity in identities(fingers):
        assert owner.setdefault(identity, finger) == finger
        before, known = newest.get(finger, (frame, identity))
        assert frame - before > 1 or identity == known
        newest[finger] = frame, identity


@pytest.mark.thorough
@settings(max_examples=40)
@given(lanes(fastest_m_s=0.25))
def test_they_keep_their_identities_through_gaps_too(fingers: list[Lane]) -> None:
    newest: dict[int, tuple[int, int]] = {}
    for finger, frame, identity in identities(fingers):
        before, known = newest.get(finger, (frame, identity))
        assert frame - before > 4 or identity == known
        newest[finger] = frame, identity


def test_two_fingers_in_one_line_do_not_take_each_others_places() -> None:
    """One arrives in every frame where the other was."""
    scene = Scene()
    apart_m, x = 3 * PITCH_M, 0.02
    first = scene.show([x, 0.05, 0], [x + apart_m, 0.05, 0]).id.tolist()
    for step_m in [*np.linspace(0.001, apart_m, 12), apart_m, apart_m, apart_m]:
        x += step_m
        at_m = [x, 0.05, 0], [x + apart_m, 0.05, 0]
        found = scene.show(*at_m)
        assert [identity_at(found, place) for place in at_m] == first


def test_where_contacts_merge_the_older_identity_stays() -> None:
    scene = Scene()
    right_m = beside(THERE, 0.03)
    small = scene.show(THERE).id.tolist()
    both = scene.show(THERE, *(right_m + [[0, 0.006 * k, 0] for k in range(4)]))
    assert both.n[0] < both.n[1]
    between = np.linspace(THERE, right_m, 8)
    merged = scene.show(*between, *(right_m + [[0, 0.006 * k, 0] for k in range(4)]))
    assert merged.id.tolist() == small


def test_where_a_contact_splits_the_larger_part_keeps_its_identity() -> None:
    scene = Scene()
    line = np.linspace(THERE, beside(THERE, 0.06), 13)
    whole = scene.show(*line)
    assert len(whole) == 1
    parts = scene.show(*line[:3], *line[7:])
    assert len(parts) == 2
    assert parts.id[0] == whole.id[0]
    assert parts.n[0] > parts.n[1]


def test_a_bridge_of_one_frame_changes_nothing() -> None:
    scene = Scene()
    right_m = beside(HERE, 4 * PITCH_M)
    first = scene.show(HERE, right_m).id.tolist()
    scene.show(HERE, right_m)
    assert len(scene.show(*np.linspace(HERE, right_m, 9))) == 1
    found = scene.show(HERE, right_m)
    assert [identity_at(found, place) for place in (HERE, right_m)] == first


def test_the_velocity_is_that_of_the_centre() -> None:
    scene = Scene()
    velocity = np.array([0.04, 0.02, 0])
    for k in range(60):
        found = scene.show(HERE + k * 0.02 * velocity, radius_m=3 * PITCH_M)
    assert np.allclose(found.velocity_m_s[0], velocity, atol=0.006)
    for _ in range(60):
        found = scene.show(HERE + 59 * 0.02 * velocity, radius_m=3 * PITCH_M)
    assert np.allclose(found.velocity_m_s[0], 0, atol=0.001)


def test_a_contact_that_grows_at_once_does_not_fly() -> None:
    """A merger moves the centre, and nothing has moved."""
    scene = Scene()
    right_m = beside(HERE, 0.05)
    for _ in range(10):
        scene.show(HERE, right_m, radius_m=2 * PITCH_M)
    found = scene.show(*np.linspace(HERE, right_m, 9), radius_m=2 * PITCH_M)
    assert len(found) == 1
    assert np.linalg.norm(found.velocity_m_s[0]) < 0.01


def test_a_contact_is_a_touch_a_hold_or_sliding() -> None:
    scene, fingertip_m = Scene(), 3 * PITCH_M
    kinds = [scene.show(HERE, radius_m=fingertip_m)[0].kind for _ in range(50)]
    assert kinds == [ContactKind.TOUCH] * 15 + [ContactKind.HOLD] * 35
    for step in range(1, 51):  # 20 mm/s
        (contact,) = scene.show(beside(HERE, step * 0.0004), radius_m=fingertip_m)
    assert contact.kind == ContactKind.SLIDING
    kinds = [scene.show(beside(HERE, 0.02), radius_m=fingertip_m)[0].kind for _ in range(50)]
    assert kinds[-1] == ContactKind.HOLD
    assert kinds.index(ContactKind.HOLD) < 45


def test_a_press_that_grows_at_its_place_does_not_slide() -> None:
    scene, kinds = Scene(), set()
    for step in range(60):
        (contact,) = scene.show(beside(HERE, 0.0031), radius_m=(1 + step / 10) * PITCH_M)
        kinds.add(contact.kind)
    assert kinds == {ContactKind.TOUCH, ContactKind.HOLD}


def test_time_that_stands_still_or_goes_back_is_borne() -> None:
    scene = Scene()
    first = scene.show(HERE).id.tolist()
    scene.time_ns -= scene.period_ns
    assert scene.show(HERE).id.tolist() == first
    scene.time_ns -= 10 * scene.period_ns
    assert scene.show(beside(HERE, 0.001)).id.tolist() == first
    found = scene.show(HERE)
    assert found.id.tolist() == first
    assert np.isfinite(found.velocity_m_s).all()


@pytest.mark.thorough
@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_any_sequence_of_patterns_gives_each_contact_one_identity(seed: int, share: float) -> None:
    scene, random = Scene(), np.random.default_rng(seed)
    known: set[int] = set()
    for _ in range(6):
        scene.time_ns += scene.period_ns
        touched = random.random(len(FLAT)) < share
        found = scene.contacts.update(random.random(len(FLAT)), touched, scene.time_ns)
        now = found.id.tolist()
        assert len(set(now)) == len(now)
        assert (np.diff(found.age_s) <= 1e-6).all()
        new = set(now) - known
        assert not new or min(new) > max(known, default=0)
        known |= set(now)


def test_merged_contacts_may_lose_all_load() -> None:
    """Two contacts share a blob of which a provisional touch without a load is left: both bells are fitted to 0."""
    scene, middle = Scene(), np.array([0.06, 0.06, 0.0])
    for step in range(26):
        away = np.array([0.02 - 0.0008 * step, 0.0, 0.0])
        merged = scene.show(middle - away, middle + away, radius_m=0.012)
    assert len(merged) == 1
    onset = np.linalg.norm(FLAT - middle, axis=1) < 0.6 * PITCH_M
    nothing = np.zeros(len(FLAT))
    left = scene.contacts.update(nothing, nothing > 0, scene.time_ns + scene.period_ns, onset=onset)
    assert (left.id.tolist(), left.load.tolist()) == (merged.id.tolist(), [0.0])
