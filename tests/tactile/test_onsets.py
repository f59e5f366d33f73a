"""Touches are found in their second frame, and contacts have events."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from skinware import Namespace
from skinware.realtime import now_ns
from skinware.tactile.baseline import Baseline
from skinware.tactile.contacts import Contacts
from skinware.tactile.contacts_service import ContactsReader, ContactsWriter
from skinware.tactile.neighbours import neighbours
from skinware.tactile.onsets import ContactEvent, EventKind, Events
from tests.specification.chain import Onsets
from tests.tactile.skins import placed, triangles
from tests.tactile.test_contacts_service import structure

FLAT = triangles(10, 12)
PRESSED = [65, 66, 77, 78]
YES = np.ones(1, bool)


def onsets_of(above: list[float], noise: float = 0.8) -> list[bool]:
    onsets = Onsets(1, 1.0)
    return [bool(onsets.update(np.full(1, one, np.float32), np.full(1, noise, np.float32), YES)[0]) for one in above]


def test_two_of_three_frames_are_an_onset() -> None:
    assert onsets_of([0, 6, 6, 6, 0]) == [False, False, True, True, False]
    assert onsets_of([0, 6, 0, 6]) == [False, False, False, True]


def test_a_spike_of_one_frame_is_none() -> None:
    assert not any(onsets_of([0, 200, 0, 0, 200, 0, 0]))


def test_nothing_is_found_within_the_noise_or_without_it() -> None:
    assert not any(onsets_of([4] * 5))
    assert not any(onsets_of([50] * 5, noise=np.nan))


class TouchedSkin:
    """A skin at rest, measured by a baseline, and what the fast channel makes of a touch."""

    def __init__(self, rate_hz: float) -> None:
        self._random = np.random.default_rng(1)
        self._baseline = Baseline(np.arange(120) // 12, np.zeros(120, int))
        geometry = placed(FLAT)
        self._contacts, self._onsets = Contacts(120, neighbours(geometry), geometry), Onsets(120, 1.0)
        self._events, self._time_ns, self._period_ns = Events(), 0, round(1e9 / rate_hz)
        for _ in range(round(8 * rate_hz)):
            self.step(0.0)

    def step(self, load: float) -> list[ContactEvent]:
        self._time_ns += self._period_ns
        pressed: npt.NDArray[np.float64] = 15 + 0.8 * self._random.standard_normal(120)
        pressed[PRESSED] += load
        values: npt.NDArray[np.float32] = np.round(pressed).astype(np.float32)
        calm = self._baseline.update(self._time_ns, values)
        onset = self._onsets.update(values - calm.baseline, np.hypot(calm.noise, calm.uncertainty), calm.usable)
        found = self._contacts.update(calm.value, calm.touched, self._time_ns, onset=onset)
        return self._events.of(found, self._time_ns)

    def steps(self, load: float, frames: int) -> Iterator[tuple[int, EventKind]]:
        """Frame and kind of each event."""
        for frame in range(frames):
            yield from ((frame, event.kind) for event in self.step(load))


@pytest.mark.parametrize("rate_hz", [20.0, 50.0, 200.0])
def test_a_touch_is_found_in_its_second_frame_and_confirmed_later(rate_hz: float) -> None:
    hand = TouchedSkin(rate_hz)
    assert not list(hand.steps(0, round(rate_hz)))
    found = list(hand.steps(8, round(rate_hz)))
    first, kind = found[0]
    assert first == 1
    assert kind == (EventKind.ONSET if rate_hz > 20 else EventKind.CONFIRMED)
    assert [kind for _, kind in found if kind is not EventKind.ONSET] == [EventKind.CONFIRMED]
    assert [kind for _, kind in hand.steps(0, round(rate_hz))] == [EventKind.ENDED]


@pytest.mark.thorough
def test_an_onset_that_ends_too_soon_is_withdrawn() -> None:
    hand = TouchedSkin(500.0)
    assert [kind for _, kind in hand.steps(8, 3)] == [EventKind.ONSET]
    assert [kind for _, kind in hand.steps(0, 100)] == [EventKind.WITHDRAWN]


def test_a_reader_has_events(namespace: Namespace) -> None:
    value = np.zeros(400)
    value[[45, 46]] = 20.0
    nothing = np.zeros(400, bool)
    with (
        ContactsWriter(structure(), namespace=namespace) as writer,
        ContactsReader(namespace=namespace, timeout_s=10) as contacts,
    ):
        events, begin_ns = contacts.events(timeout_s=10), now_ns()
        writer.publish(0 * value, nothing, begin_ns, onset=value > 0)
        found = [next(events)]
        writer.publish(value, value > 0, begin_ns + 20_000_000)
        found.append(next(events))
        writer.publish(0 * value, nothing, begin_ns + 200_000_000)
        found.append(next(events))
        assert [event.kind for event in found] == [EventKind.ONSET, EventKind.CONFIRMED, EventKind.ENDED]
        assert {event.contact.id for event in found} == {1}
        assert (found[0].contact.load, found[1].contact.load) == (0, 40)
        assert found[0].contact.taxels.tolist() == [45, 46]
