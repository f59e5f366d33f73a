"""What small emulated devices feel."""

from __future__ import annotations

import numpy as np

from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.tactile.contacts import Contacts
from skinware.tactile.neighbours import neighbours
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.virtual import on_a_grid, on_pads
from skinware_drivers.virtual.emulator import WanderingPress


def test_a_device_is_touched_and_then_rests_for_longer_than_a_baseline_takes() -> None:
    press = WanderingPress(0, 1, on_a_grid(16, 4))
    times_s = np.arange(0, 65, 0.1)
    is_touched = np.array([press.strength(time_s).max() > 0 for time_s in times_s])
    ends_s = times_s[1:][np.diff(is_touched.astype(int)) == -1]
    begins_s = times_s[1:][np.diff(is_touched.astype(int)) == 1]
    rests_s = [begins_s[begins_s > end_s][0] - end_s for end_s in ends_s if (begins_s > end_s).any()]
    assert sum(rest_s > 6 for rest_s in rests_s) == 2
    assert min(np.diff(ends_s)) > 3
    assert len(ends_s) >= 12


def test_a_finger_presses_one_pad_after_another_and_a_few_taxels_that_hang_together() -> None:
    shapes = [(96, 8), (9, 3), (112, 14)]
    pad = np.repeat([0, 1, 2], [count for count, _ in shapes])
    press = WanderingPress(0, 1, on_pads(*shapes))
    pressed: list[int] = []
    for time_s in np.arange(0, 30, 0.1):
        taxels = np.flatnonzero(press.strength(time_s))
        if not len(taxels):
            continue
        [on] = set(pad[taxels].tolist())
        row, column = np.divmod(taxels - np.flatnonzero(pad == on)[0], shapes[on][1])
        assert np.ptp(row) <= 4
        assert np.ptp(column) <= 4
        pressed += [on] if not pressed or pressed[-1] != on else []
    assert pressed == [0, 1, 2] * 2


def test_a_part_without_neighbours_is_pressed_alone() -> None:
    press = WanderingPress(0, 1, on_pads(*[(1, 1)] * 4))
    assert {np.count_nonzero(press.strength(time_s)) for time_s in np.arange(0, 20, 0.1)} == {0, 1}


def test_places_without_pads_are_one_pad() -> None:
    press = WanderingPress(0, 1, on_a_grid(16, 4)[:, :2])
    assert np.array_equal(press.strength(2.0), WanderingPress(0, 1, on_a_grid(16, 4)).strength(2.0))
    assert press.strength(2.0).max() > 0.9


def test_three_fingers_press_a_hand_at_once_each_is_a_contact_with_one_identity() -> None:
    grid, hand = Grid(12, 6), Hand("right")
    at = [
        grid.at(hand.down(finger, [grid])[0], ["force"], range(72 * n, 72 * n + 72)) for n, finger in enumerate(FINGERS)
    ]
    places, press = Geometry.joined(at), WanderingPress(0, 1, on_pads(*[(72, 6)] * 5))
    contacts = Contacts(len(places), neighbours(places), places)
    together, identities = set[int](), set[int]()
    for number in range(20 * 30):
        load = np.rint(200 * press.strength(number / 20))
        found = contacts.update(load, load > 4, number * 50_000_000)
        together.add(len(found))
        identities |= set(found.id.tolist())
    assert together == {0, 3}
    assert identities == set(range(1, 19))
