"""A module whose taxels are in two blocks of registers, one of which the device stops answering for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from skinware import Status
from skinware_drivers.modbus import Registers
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.rig import Suite, play
from skinware_drivers.virtual import Device
from skinware_drivers.virtual.hand_clock import HandClock
from tests.modbus.hands import Array, EmulatedArray


class InTwoBlocks(Array):
    registers = (  # type: ignore[assignment]
        Registers(7, 18, function=4),
        Registers(300, 18, function=4, to=range(18, 36)),
    )


class EmulatedInTwoBlocks(EmulatedArray):
    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        return {(7 if number < 18 else 282) + number: value for number, value in enumerate(values)}


class OfTwoBlocks(Suite):
    driver = InTwoBlocks
    emulator = EmulatedInTwoBlocks


@pytest.mark.thorough
def test_only_the_taxels_of_the_silent_block_are_stale() -> None:
    async def scenario(clock: HandClock) -> None:
        async with OfTwoBlocks().running(clock) as rig:
            await until_fresh(rig)
            rig.devices.silent.add("300")
            await rig.sleep(2.0)
            frame = rig.record.frames[-1]
            fresh = frame.fresh("pressure", at_ns=clock.now_ns)
            assert np.array_equal(fresh, np.arange(36) < 18)
            assert np.array_equal((frame.status & Status.STALE) != 0, np.arange(36) >= 18)
            rig.devices.silent.clear()
            await rig.sleep(3.0)
            assert rig.record.frames[-1].fresh("pressure", at_ns=clock.now_ns).all()

    play(scenario)
