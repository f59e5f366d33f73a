"""The base of the suite's tests: rigs of a driver, and the values that emulated devices feel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.testing.rig import Case, Handshakes, Running
from skinware_drivers.testing.waiting import require
from skinware_drivers.testing.wire import Pattern
from skinware_drivers.virtual.emulator import each_value
from skinware_drivers.virtual.hand_clock import HandClock

Values = npt.NDArray[np.int64]


def limits(emulator: Any, n_values: int) -> tuple[Values, Values]:
    """Return the least and the greatest value that each sensor of a device can send."""
    lowest = each_value("lowest", getattr(emulator, "lowest", 0), n_values)
    return lowest, each_value("full_scale", emulator.full_scale, n_values)


def lively(emulator: Any) -> Pattern:
    """Return a pattern with another random value for every sensor, device and burst, so that any mix-up shows."""

    def feel(number: int, cycle: int, n_values: int) -> Values:
        lowest, highest = limits(emulator, n_values)
        return np.random.default_rng([number, cycle, 7]).integers(lowest, highest, n_values, endpoint=True)

    return feel


def extreme(emulator: Any) -> Pattern:
    """Return a pattern of range ends and bit patterns by turns, with lively values between them."""
    between = lively(emulator)

    def feel(number: int, cycle: int, n_values: int) -> Values:
        lowest, highest = limits(emulator, n_values)
        odd = np.arange(n_values) % 2
        middle = lowest + (highest - lowest + 1) // 2
        moments = (
            lowest,
            highest,
            lowest | (highest & 0x5555_5555) if (lowest == 0).all() else 0x55,
            lowest | (highest & 0xAAAA_AAAA) if (lowest == 0).all() else -0x56,
            np.where(odd, lowest, highest),
            np.where(odd, highest, lowest),
            middle,
            middle - 1,
            -1,
            1,
        )
        which, is_between = divmod(cycle, 2)
        if is_between:
            return between(number, cycle, n_values)
        return np.clip(moments[which % len(moments)], lowest, highest)

    return feel


class Suite:
    """A driver and its emulator.

    Attributes:
        driver_options: options of the driver, as in a configuration file.
        emulator_options: options of the emulator, beside those that the tests set.
    """

    driver: ClassVar[type[AnyAdapter]]
    emulator: ClassVar[Any]
    driver_options: ClassVar[Mapping[str, Any]] = {}
    emulator_options: ClassVar[Mapping[str, Any]] = {}

    def shown(self, felt: Sequence[int]) -> Sequence[int]:
        """Return the values that a device can send for the values that it felt: override it if they are fewer."""
        return felt

    @property
    def case(self) -> Case:
        return Case(self.driver, self.emulator, self.driver_options, self.emulator_options, self.shown)

    def running(self, clock: HandClock, **more: Any) -> Running:
        """Return the running driver on devices that feel new values in each burst."""
        return Running(self.case, clock, more.pop("pattern", lively)(self.emulator), **more)

    def handshakes(self, clock: HandClock, **more: Any) -> Handshakes:
        return Handshakes(self.case, clock, lively(self.emulator), **more)

    @staticmethod
    def require_all_counted(rig: Running) -> None:
        counters = rig.counters()
        came = counters["frames"] + counters["refused"] + counters["dropped"]
        if rig.adapter.medium == "can":
            require(came == rig.wire.frames, f"{rig.wire.frames} frames came, the bus counted {came}")
        layout = rig.adapter.layout
        if layout.cycle is not None and len(layout.cycle.members) < len(layout.frames):
            return  # updates may have had any number of frames
        used = counters["updates"] * layout.cycle_length + rig.answers
        used += sum(counters[name] for name in ("unknown", "bad_length", "bad_content", "orphans"))
        structure = rig.record.frames[-1].structure
        groups = structure.n_patches if layout.cycle and layout.cycle.within == "patch" else structure.n_modules
        require(
            0 <= counters["frames"] - used <= groups * (layout.cycle_length - 1),  # which may still wait for others
            f"{counters['frames']} frames came in, {used} were shown, counted, or answers to the driver: {counters}",
        )
