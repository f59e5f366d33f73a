"""Features of touch: contacts as rows, what vibrates in which band, and what slips."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import Namespace
from skinware.errors import ConfigurationError
from skinware.learning.features import CONTACT_NUMBERS, contact_numbers, slip, spectrogram
from skinware.tactile.contacts_service import ContactsReader, ContactsWriter
from tests.tactile.skins import AT_ONCE, PITCH_M, pressed
from tests.tactile.test_contacts_service import FLAT, structure


def test_contacts_are_rows_the_largest_first(namespace: Namespace) -> None:
    value = pressed(FLAT, [[0.02, 0.02, 0]], 3 * PITCH_M, load=1000.0)
    value += pressed(FLAT, [[0.1, 0.08, 0]], 3 * PITCH_M, load=3000.0)
    with (
        ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace) as writer,
        ContactsReader(namespace=namespace) as reader,
    ):
        published = writer.publish(value, value > 0, 10**9)
        rows = contact_numbers(reader.latest(), 3)
        assert rows.shape == (3, len(CONTACT_NUMBERS))
        assert rows.dtype == np.float32
        assert rows[0, 0] == published.load.max() > rows[1, 0] == published.load.min() > 0
        assert np.array_equal(rows[:2], contact_numbers(published, 2))
        assert np.allclose(rows[0, 2:4], (0.1, 0.08), atol=PITCH_M)
        assert (rows[2] == 0).all()
    assert (contact_numbers(None, 2) == 0).all()


def test_a_vibration_is_in_its_band_alone() -> None:
    time_s = np.arange(200) / 400
    values = np.column_stack((3 * np.sin(2 * np.pi * 60 * time_s), 100 + 50 * time_s, np.zeros(200)))
    bands = spectrogram(values, 400)
    assert bands.shape == (4, 3)
    assert bands[2, 0] == pytest.approx(3 / np.sqrt(2), rel=0.02)  # 40 to 80 Hz
    assert (bands[[0, 1, 3], 0] < 0.05).all()
    assert (bands[:, 1:] < 1e-3).all()  # a slope is no vibration


@pytest.mark.parametrize("count", [16, 17])
def test_bands_have_the_whole_power_of_noise(count: int) -> None:
    noise = np.random.default_rng(1).normal(0, 2, (count, 4000))
    whole = spectrogram(noise, 100, (1e-9, 51))
    assert np.sqrt((whole**2).mean()) == pytest.approx(2, rel=0.12)  # but for mean and slope


def test_what_vibrates_slips_and_what_is_pressed_does_not() -> None:
    time_s, generator = np.arange(50) / 200, np.random.default_rng(2)
    rest = generator.normal(0, 0.5, (50, 3))
    values = rest + np.column_stack((20 + 8 * np.sin(2 * np.pi * 45 * time_s), 100 * time_s, np.zeros(50)))
    vibrating, pressed_more, still = slip(values, 200, quiet=1.0)
    assert vibrating > 0.5 > 0.1 > pressed_more
    assert still < 0.1


def test_windows_that_are_too_short_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="needs 4 samples"):
        spectrogram(np.zeros((3, 1)), 100)
    with pytest.raises(ConfigurationError, match="ascending"):
        spectrogram(np.zeros((9, 1)), 100, (5, 5))
