"""What waits for its partner is given up when it is known that frames were lost."""

from __future__ import annotations

from typing import Any

import pytest

from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.rig import Suite, play
from skinware_drivers.virtual.hand_clock import HandClock
from tests.testing.fingertips import EmulatedFingertips, Fingertips


class _Fingers(Suite):
    driver = Fingertips
    emulator = EmulatedFingertips


@pytest.mark.parametrize("counter", ["dropped", "overflows", "bus_offs"])
def test_a_bus_that_counts_a_loss_is_told_to_the_decoder_once(counter: str, namespace: object) -> None:
    async def scenario(clock: HandClock) -> list[list[int]]:
        told: list[list[int]] = []
        async with _Fingers().running(clock) as rig:
            await until_fresh(rig)
            assert rig.runner is not None
            assert rig.runner.builder.generation is not None
            generation: Any = rig.runner.builder.generation
            ask = generation.interrupted

            def interrupted() -> list[int]:
                told.append(ask())
                return told[-1]

            generation.interrupted = interrupted
            await rig.sleep(0.1)
            assert told
            assert not any(told)
            counters = rig.bus.counters
            setattr(counters, counter, getattr(counters, counter) + 1)
            await rig.sleep(0.1)
            return [interrupted for interrupted in told if interrupted]

    assert play(scenario) == [[0]]
