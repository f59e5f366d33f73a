"""Hands with magnetic fingers that turn in the field of the earth: all seeds of a world at once, a patch each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware import Structure
from skinware.sensor_types import MAGNETIC_FIELD, PRESSURE, SHEAR_X, SHEAR_Y
from skinware.tactile.chain import BaselineStageSettings
from skinware.tactile.stages import Signal, Stage, Taxels
from skinware.tactile.vectors import FieldSettings, VectorSettings

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

PLACES = {
    "anyskin": np.array([[0, 0], [-7, -7], [-7, 7], [7, -7], [7, 7]], float),
    "xela": 4.7 * np.indices((4, 4)).reshape(2, -1).T.astype(float),
}
"""Places of the magnetometers of a finger, mm."""
EVERY_S, FIRST_S = 8.0, 16.0
IDLE_UT = 0.3
"""A smaller load is none."""


class Frame(NamedTuple):
    """As much of a snapshot as a chain reads."""

    structure: Structure
    acquired_ns: int
    values: npt.NDArray[Any]
    status: npt.NDArray[np.uint8]

    def physical_values(self) -> npt.NDArray[np.float32]:
        return self.values.astype(np.float32)


@dataclass
class Turning:
    """Worlds of seeds that turn in 50 microtesla, with gains and angles of axes that differ by 5 %.

    Attributes:
        kind: the finger.
        seeds: how many.
        until_s: the end.
        speed: of turning, about rad/s.
        press: microtesla by which a press changes the field at its taxel.
        grip: share of the taxels that a grip loads, instead of presses; None: presses.
        begin_s: the hand turns from then on.
        lost: share of the frames that do not arrive from a taxel.
        covered: the first taxel is pressed during the first 1.5 s.
    """

    kind: str
    seeds: int = 20
    until_s: float = 60.0
    rate_hz: float = 50.0
    speed: float = 1.5
    press: float = 150.0
    grip: float | None = None
    begin_s: float = 0.0
    lost: float = 0.0
    covered: bool = False

    def __post_init__(self) -> None:
        self.random = np.random.default_rng(1)
        self.place = PLACES[self.kind]
        self.time_s = np.arange(round(self.until_s * self.rate_hz)) / self.rate_hz
        shape = len(self.time_s), self.seeds, 3, len(self.place)
        self.load: Floats = np.zeros(shape)
        self.pressed: list[tuple[float, npt.NDArray[np.intp]]] = []
        for begin_s in np.arange(FIRST_S, self.until_s - 6, EVERY_S):
            self._press(begin_s)
        if self.covered:
            self.load[self.time_s < 1.5, :, 2, 0] += self.press
        gains = 0.05 * self.random.standard_normal((self.seeds, len(self.place), 1, 1)) * np.eye(3)
        angles = 0.05 * self.random.standard_normal((self.seeds, len(self.place), 3, 3)) * (1 - np.eye(3))
        values = np.einsum("snij,tsj->tsin", np.eye(3) + gains + angles, self._field())
        values += self.load + 100 * self.random.standard_normal(shape[1:])
        drift = self.random.standard_normal((self.seeds, 3, 1)) * (1 + 0.3 * self.random.standard_normal(shape[1:]))
        values += 2 / 60 * self.time_s[:, None, None, None] * drift
        values += 0.5 * self.random.standard_normal(shape)
        self.values = values.astype(np.float32)
        self.usable: Flags = self.random.random((shape[0], self.seeds, shape[3])) >= self.lost

    def _press(self, begin_s: float) -> None:
        n, random = len(self.place), self.random
        profile = np.interp(self.time_s, begin_s + np.array([0, 0.2, 3.0, 3.2]), [0, 1, 1, 0])[:, None, None, None]
        centre = random.integers(0, n, self.seeds)
        lean = 0.3 * random.standard_normal((self.seeds, 2))
        if self.grip is None:
            away = self.place - self.place[centre][:, None]
            bell = np.exp(-0.5 * (away**2).sum(axis=2) / 16)
            bell[bell < 0.002] = 0
            shear = np.moveaxis(away, 2, 1) / 8 + lean[..., None]
        else:
            loaded = np.arange(n) < round(self.grip * n)
            bell = loaded * np.clip(1 + 0.2 * random.standard_normal((self.seeds, n)), 0.5, 2)
            centre[:] = 0
            shear = np.repeat(lean[..., None], n, axis=2)
        load = np.concatenate([shear, np.ones((self.seeds, 1, n))], axis=1) * bell[:, None]
        self.load += self.press * profile * load
        self.pressed.append((begin_s, centre))

    def _field(self) -> Floats:
        """(m, seeds, 3) the field in the coordinate frame of each hand."""
        rates = np.array([0.05, 0.11, 0.23, 0.4])
        size = self.random.standard_normal((4, self.seeds, 3)) * self.speed / 2
        phase = self.random.uniform(0, 2 * np.pi, (4, self.seeds, 3))
        spin = (size * np.sin(2 * np.pi * rates[:, None, None] * self.time_s[:, None, None, None] + phase)).sum(axis=1)
        spin[self.time_s < self.begin_s] = 0
        field = self.random.standard_normal((self.seeds, 3))
        field *= 50 / np.linalg.norm(field, axis=1, keepdims=True)
        found: Floats = np.zeros_like(spin)
        for row, turn in enumerate(spin / self.rate_hz):
            angle = np.linalg.norm(turn, axis=1, keepdims=True) + 1e-12
            axis = turn / angle
            along = (axis * field).sum(axis=1, keepdims=True) * axis
            field = along + np.cos(angle) * (field - along) - np.sin(angle) * np.cross(axis, field)
            found[row] = field
        return found

    def taxels(self) -> tuple[Taxels, ...]:
        """The axes of all seeds."""
        n = len(self.place)
        patch = np.repeat(np.arange(self.seeds), n)
        uid = np.arange(self.seeds * n, dtype=np.uint64)
        if self.kind == "anyskin":
            return tuple(Taxels(one.measured(unit="uT"), uid, patch, patch) for one in MAGNETIC_FIELD)
        kinds = [one.measured(unit="counts", minimum=-1e6, maximum=1e6) for one in (SHEAR_X, SHEAR_Y, PRESSURE)]
        return tuple(Taxels(one, uid, np.arange(len(uid)), patch) for one in kinds)


@dataclass
class Judged:
    """Result of worlds that turned, by seed.

    Attributes:
        false: share of the idle time that was shown as touched.
        on: least share of a press that was shown at its taxel.
        wrong: median of the errors of shown vectors, as shares of their lengths.
        left: share of the taxels that were touched 3 s after the last press.
    """

    false: Floats
    on: Floats
    wrong: Floats
    left: Floats


def judge(world: Turning, *, field: bool = True) -> Judged:
    """Let a chain for vectors see a world, with or without its first stage."""
    axes = world.taxels()
    first: list[Stage] = [FieldSettings().stage(*axes)] if field else []
    axes = first[0].axes if first else axes
    calm = [BaselineStageSettings().stage(one) for one in axes]
    last = VectorSettings().stage(*axes)
    shape = len(world.time_s), world.seeds, len(world.place)
    shown = np.zeros((shape[0], 3, *shape[1:]), np.float32)
    for row, time_s in enumerate(world.time_s):
        usable = world.usable[row].ravel()
        signals = [
            Signal.of(round((1 + time_s) * 1e9), world.values[row, :, axis].ravel(), usable) for axis in range(3)
        ]
        for stage in first:
            stage.step(*signals)
        for stage, signal in zip(calm, signals, strict=True):
            stage.step(signal)
        last.step(*signals)
        shown[row] = np.stack([one.values.reshape(shape[1:]) for one in signals])
    shown = np.moveaxis(shown, 1, 2)
    touched = (shown != 0).any(axis=2)
    idle = (np.linalg.norm(world.load, axis=2) < IDLE_UT) & (world.time_s > 6)[:, None, None]
    seed = np.arange(world.seeds)
    on, wrong = [], []
    for begin_s, centre in world.pressed:
        rows = (world.time_s >= begin_s + 0.4) & (world.time_s < begin_s + 3)
        on.append(touched[rows][:, seed, centre].mean(axis=0))
        true, seen = (of[rows][:, seed, :, centre] for of in (world.load, shown))
        wrong.append(np.median(np.linalg.norm(seen - true, axis=2) / np.linalg.norm(true, axis=2), axis=1))
    after = world.time_s > world.pressed[-1][0] + 6.2
    return Judged(
        (touched & idle).sum(axis=(0, 2)) / idle.sum(axis=(0, 2)),
        np.min(on, axis=0),
        np.median(wrong, axis=0),
        touched[after].mean(axis=(0, 2)),
    )
