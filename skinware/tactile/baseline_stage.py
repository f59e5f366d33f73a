"""Take baselines away as a stage of a chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Flags, Floats
from skinware.tactile.baseline import Baseline, Calm
from skinware.tactile.curves import TEMPERATURE
from skinware.tactile.rule import BaselineSettings
from skinware.tactile.stages import Signal, Stage, Taxels

RESTLESS = (TEMPERATURE, "acceleration_", "angular_rate_")
"""Beginnings of the names of types that have no rest to go back to."""


class BaselineStageSettings(BaselineSettings, frozen=True, kw_only=True, tag_field="stage", tag="baseline"):
    """Settings of a baseline as a stage: 0 = no touch; the unit stays.

    Attributes:
        types: the sensor types that it is for; None: all for which it can be made.
    """

    types: tuple[str, ...] | None = None

    def stage(self, taxels: Taxels) -> BaselineStage:
        name, unit = taxels.type.name, taxels.type.unit
        if name.startswith(RESTLESS):
            raise ConfigurationError(f"a {name} has no rest to return to")
        if name == "proximity" and unit == "m":
            raise ConfigurationError(
                "a proximity in m falls when something comes near; baselines are for rising values"
            )
        given = {field: getattr(self, field) for field in BaselineSettings.__struct_fields__}
        return BaselineStage(taxels, BaselineSettings(**given))


class BaselineStage(Stage):
    """Takes the baselines of n taxels away.

    Attributes:
        baseline: the baselines.
        before: the taxels as they come in.
        given: (n,) float32, the values of the newest frame as they came in.
        calm: the same, calmed; None before the first frame.
    """

    name = "baseline"

    def __init__(self, taxels: Taxels, settings: BaselineSettings) -> None:
        self.before = taxels
        before = taxels.type
        span = before.maximum - before.minimum
        calmed = replace(before, minimum=-span if taxels.signed else 0.0, maximum=span)
        super().__init__(replace(taxels, type=calmed, resolution=0.0))
        self.baseline = Baseline(
            taxels.module,
            taxels.patch,
            settings,
            resolution=taxels.resolution,
            signed=taxels.signed,
            common=taxels.common,
            limits=(before.minimum, before.maximum),
        )
        self.given: Floats = np.full(len(taxels), np.nan, np.float32)
        self.calm: Calm | None = None

    @property
    def touched(self) -> Flags:
        """(n,) bool, which taxels are touched in the newest frame."""
        return np.zeros(len(self.taxels), bool) if self.calm is None else self.calm.touched

    def step(self, signal: Signal) -> None:
        self.given = signal.values
        self.calm = calm = self.baseline.update(
            signal.time_ns, signal.values, signal.usable, jumped=signal.jumped, bears=signal.bears
        )
        signal.deviation = signal.values - calm.baseline
        signal.values = calm.value
        signal.forced |= calm.forced
        signal.unknown |= np.isnan(calm.baseline)
