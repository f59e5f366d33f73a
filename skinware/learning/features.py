"""Features of touch for learning: numbers of modules, point sets, contacts, spectrograms, and slip."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.skin_layout import SkinLayout
from skinware.tactile.contacts import ContactSet
from skinware.tactile.contacts_service import ContactsSample

Positions = npt.NDArray[np.int64]
Each = Literal["module", "taxel", "point"]


def state_name(number: str) -> str:
    """Return the name of a number of touch in the state of a robot: ``touch.NUMBER.vel``.

    LeRobot's rollout gives a policy only numbers whose names end in ``.pos`` or ``.vel``, and moves the robot back to
    those in ``.pos`` (huggingface/lerobot v0.6.1, lerobot/rollout/context.py).
    """
    return f"touch.{number}.vel"


class Totals:
    """Named numbers of some sensors: of each module the sum and the largest value, every sensor, or a point set.

    Args:
        layout: of the skin.
        type_name: their type.
        positions: (n,) as of :meth:`ChosenSensors.of`.
        each: ``module``: two numbers for each module; ``taxel``: one for each sensor; ``point``: the six of
            :func:`points` for each sensor.

    Attributes:
        names: of the numbers: ``right_hand.index_tip.sum``, ``right_hand.index_tip.peak``; ``...taxel_3``;
            ``...taxel_3.x`` to ``...taxel_3.fz``.
    """

    def __init__(self, layout: SkinLayout, type_name: str, positions: Positions, each: Each = "module") -> None:
        module_of = layout.module_of(type_name)[positions]
        modules, self._row = np.unique(module_of, return_inverse=True)
        self._each = each
        self._points: Callable[[npt.NDArray[Any]], npt.NDArray[Any]] = lambda values: points(
            layout, values, type_name, positions
        )
        if each == "module":
            texts = [layout.modules[module] for module in modules.tolist()]
            self.names: tuple[str, ...] = tuple(f"{_slug(text)}.{what}" for text in texts for what in ("sum", "peak"))
        else:
            self.names = tuple(_slug(layout.sensor_name(type_name, position)) for position in positions.tolist())
        if each == "point":
            self.names = tuple(f"{name}.{axis}" for name in self.names for axis in ("x", "y", "z", "fx", "fy", "fz"))

    def of(self, values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Return (len(names),) float32 of (n,) values."""
        if self._each == "point":
            return self._points(values).ravel()
        if self._each == "taxel" or not len(values):
            return values.astype(np.float32)
        sums = np.bincount(self._row, values)
        peaks = np.full(len(sums), -np.inf)
        np.maximum.at(peaks, self._row, values)
        return np.column_stack((sums, peaks)).ravel().astype(np.float32)


def points(layout: SkinLayout, values: npt.NDArray[Any], type_name: str, positions: Positions) -> npt.NDArray[Any]:
    """Return (..., n, 6) float32 ``[x, y, z, Fx, Fy, Fz]``: places in m in their frames, and force against the skin.

    The force is the value, in the unit of the type, against the outward normal; 0 where the normal is not known, as is
    the place.

    Args:
        values: (..., n) of the sensors at ``positions``.
    """
    geometry = layout.geometry(type_name)
    place = np.nan_to_num(geometry.position_m[positions])
    force = -values[..., np.newaxis] * np.nan_to_num(geometry.normal[positions])
    found: npt.NDArray[np.float32] = np.concatenate((np.broadcast_to(place, force.shape), force), axis=-1).astype("f4")
    return found


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", text.replace(", ", ".")).strip("_")


CONTACT_NUMBERS = ("load", "peak", "x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z", "age_s")
"""Names of the columns of :func:`contact_numbers`."""


def contact_numbers(contacts: ContactSet | ContactsSample | None, count: int) -> npt.NDArray[np.float32]:
    """Return (count, 9) float32: the contacts with the largest loads as rows, for a policy that wants a fixed shape.

    Columns: :data:`CONTACT_NUMBERS`. Rows beyond the contacts there are, and numbers that are not known, are 0.

    Args:
        contacts: of one moment; None: none.
        count: number of rows.
    """
    rows = np.zeros((count, len(CONTACT_NUMBERS)), np.float32)
    if contacts is None:
        return rows
    found = contacts.contacts if isinstance(contacts, ContactsSample) else contacts
    chosen = np.argsort(-found.load, kind="stable")[:count]
    columns = (found.load, found.peak, found.cop_m, found.normal, found.age_s)
    numbers = np.column_stack([column[chosen] for column in columns])
    rows[: len(chosen)] = np.nan_to_num(numbers)
    return rows


def spectrogram(
    values: npt.NDArray[Any], rate_hz: float, bands_hz: npt.ArrayLike = (5.0, 20.0, 40.0, 80.0, 160.0)
) -> npt.NDArray[np.float32]:
    """Return (bands, n) float32: how strongly each value vibrates in each band of frequencies, in its unit.

    It is the root mean square of the part of each value in a band, after its mean and slope are taken away. A band
    above half the rate is 0.

    Args:
        values: (samples, n) at a fixed rate, the oldest first.
        rate_hz: samples a second.
        bands_hz: (bands + 1,) limits of the bands, ascending.

    Raises:
        ConfigurationError: fewer than 4 samples, or limits that do not ascend.
    """
    limits = np.asarray(bands_hz, np.float64)
    if len(values) < 4 or limits.ndim != 1 or len(limits) < 2 or (np.diff(limits) <= 0).any():
        raise ConfigurationError("a spectrogram needs 4 samples and limits of bands in ascending order")
    samples = len(values)
    time = np.linspace(-1.0, 1.0, samples)
    flat = np.asarray(values, np.float64) - np.mean(values, axis=0)
    flat -= np.outer(time, time @ flat / (time @ time))
    window = np.hanning(samples)
    power = np.abs(np.fft.rfft(flat * window[:, np.newaxis], axis=0)) ** 2
    power[1 : None if samples % 2 else -1] *= 2  # the other half of the spectrum is its mirror
    power /= samples * (window @ window)
    frequency = np.fft.rfftfreq(samples, 1 / rate_hz)
    bands = [power[(frequency >= low) & (frequency < high)].sum(axis=0) for low, high in pairwise(limits)]
    found: npt.NDArray[np.float32] = np.sqrt(np.array(bands)).astype(np.float32)
    return found


def slip(values: npt.NDArray[Any], rate_hz: float, quiet: npt.ArrayLike = 1.0) -> npt.NDArray[np.float32]:
    """Return (n,) float32 in 0 to 1: how much of each value's change is vibration, as of something that slips.

    0: at rest, or pressed ever more; towards 1: it vibrates above 20 Hz more than it changes slowly. It is a feature
    to learn from: an impact vibrates as well. ``Contact.slips`` detects.

    Args:
        values: (samples, n), at least 0.1 s at 100 Hz or more, the oldest first.
        rate_hz: samples a second.
        quiet: (n,) or one number: noise of each value at rest, in its unit; weaker vibration counts as none.

    Raises:
        ConfigurationError: as :func:`spectrogram`.
    """
    slow, fast = spectrogram(values, rate_hz, (1.0, 20.0, max(40.0, rate_hz / 2 + 1)))
    trend = np.abs(np.asarray(values[-1], np.float64) - values[0])
    above = np.maximum(fast - np.asarray(quiet, np.float64), 0.0)
    found: npt.NDArray[np.float32] = (above / (above + slow + trend + np.asarray(quiet))).astype(np.float32)
    return found
