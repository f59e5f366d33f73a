"""What every driver must do with its devices, whatever they are: right values in order, and honesty about faults."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Coroutine
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, PatchState, Status
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.events import spoilt_bursts
from tests.drivers.bench import Bench, Case
from tests.drivers.cases import CASES
from tests.sdk.driving import driving_lines, read_until

RUN_MS = 800
CYCLES = 400


def play(scenario: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(scenario, 60))


class Score:
    """Which bursts were shown for each module, and which updates were of no burst at all."""

    def __init__(self, bench: Bench) -> None:
        structure = bench.decoder.tables.structure
        numbers = list(bench.hardware.numbers)
        expected = {number: bench.case.expected(number, CYCLES) for number in numbers}
        first_of_patch = np.searchsorted(structure.sensor_patch, np.arange(structure.n_patches))
        first_of_module = np.searchsorted(structure.sensor_module, np.arange(structure.n_modules))
        self.shown: dict[tuple[int, int], list[int]] = {}  # (number, module) -> cycles
        self.wrong: list[tuple[int, list[int]]] = []
        for patch, module, values in bench.updates:
            number = numbers[patch]
            begin = int(first_of_module[module] - first_of_patch[patch])
            cycles = self.shown.setdefault((number, module), [])
            last = cycles[-1] if cycles else 0
            match = (expected[number][last:, begin : begin + len(values)] == values).all(axis=1)
            if match.any():
                cycles.append(last + int(match.argmax()))
            else:
                self.wrong.append((number, values))


def bursts_of(bench: Bench) -> int:
    return min(device.cycle for device in bench.hardware.devices.values())


@pytest.mark.parametrize("case", CASES)
def test_every_value_of_every_burst_is_shown_once_and_in_order(case: Case) -> None:
    async def scenario() -> None:
        async with Bench(case) as bench:
            await bench.run(RUN_MS)
            await bench.stop()
            score = Score(bench)
            assert score.wrong == []
            structure = bench.decoder.tables.structure
            assert len(score.shown) == structure.n_modules
            for (number, _), cycles in score.shown.items():
                last = bench.hardware.devices[number].cycle
                assert cycles in (list(range(cycles[0], last)), list(range(cycles[0], last - 1)))  # one may be cut
                assert cycles[0] <= 2  # at most what came before anybody listened
            assert bursts_of(bench) > 10
            assert bench.fresh
            for name in ("unknown", "bad_length", "bad_content", "orphans", "late"):
                assert bench.count(name) == 0, name

    play(scenario())


@pytest.mark.parametrize("fault", ["lose", "truncate", "repeat"])
@pytest.mark.parametrize("case", CASES)
def test_nothing_torn_is_shown_and_every_whole_burst_is(case: Case, fault: str) -> None:
    async def scenario() -> None:
        async with Bench(case, **{fault: 0.2}) as bench:
            await bench.run(RUN_MS)
            await bench.stop()
            score = Score(bench)
            faults = bench.faults()
            assert len(faults) > 5
            assert score.wrong == []
            spoilt = spoilt_bursts(bench.log) | {(e.board, e.cycle) for e in faults}
            for (number, _), cycles in score.shown.items():
                last = bench.hardware.devices[number].cycle - 1  # which may still be on its way
                whole = {c for c in range(cycles[0], last) if (number, c) not in spoilt}
                assert whole <= set(cycles)
            n_truncated = len(bench.faults("truncated"))
            assert n_truncated - 2 <= bench.count("bad_length") <= n_truncated  # before anybody listened, or unsent
            assert bench.count("unknown") == 0

    play(scenario())


@pytest.mark.parametrize("case", CASES)
def test_random_bytes_under_the_devices_own_identifiers_raise_nothing(case: Case) -> None:
    async def scenario() -> None:
        async with Bench(case, corrupt=0.2) as bench:
            await bench.run(RUN_MS)
            await bench.stop()
            score = Score(bench)
            spoilt = spoilt_bursts(bench.log)
            assert len(bench.faults("corrupted")) > 5
            assert len(score.wrong) <= len(bench.faults("corrupted"))  # nothing checks these bytes
            assert bench.count("updates") == len(bench.updates)
            for (number, _), cycles in score.shown.items():
                last = bench.hardware.devices[number].cycle - 1
                assert {c for c in range(cycles[0], last) if (number, c) not in spoilt} <= set(cycles)

    play(scenario())


@pytest.mark.parametrize("case", CASES)
def test_random_frames_raise_nothing_and_all_are_accounted_for(case: Case) -> None:
    random = np.random.default_rng(5)

    async def scenario() -> None:
        async with Bench(case) as bench:
            own = sorted(bench.hardware.identifiers)
            n_frames = 2000
            before = sum(bench.count(name) for name in ("unknown", "bad_length", "bad_content"))
            for _ in range(n_frames // 50):
                identifiers = [*random.choice(own, 40), *random.integers(0, 0x8000_07FF, 10)]
                await bench.inject([(int(i), random.bytes(int(random.integers(0, 9)))) for i in identifiers])
            refused = sum(bench.count(name) for name in ("unknown", "bad_length", "bad_content")) - before
            assert n_frames / 10 < refused <= n_frames
            assert bench.attends

    play(scenario())


@pytest.mark.parametrize("case", CASES)
def test_foreign_frames_are_counted_and_disturb_nothing(case: Case) -> None:
    async def scenario() -> None:
        async with Bench(case, foreign_hz=500) as bench:
            bench.decoder.state.bus_counters[:] = 0
            before = bench.hardware.totals()["foreign"]
            await bench.run(RUN_MS)
            foreign = bench.hardware.totals()["foreign"] - before
            score = Score(bench)
            assert score.wrong == []
            assert all(np.diff(cycles).tolist() == [1] * (len(cycles) - 1) for cycles in score.shown.values())
            assert foreign > 200
            assert abs(bench.count("unknown") - foreign) <= 2  # on the wire when counting began or ended
            assert bench.count("bad_length") == bench.count("bad_content") == 0

    play(scenario())


@pytest.mark.parametrize("case", CASES)
def test_a_device_that_dies_holds_up_no_other(case: Case) -> None:
    async def scenario() -> None:
        async with Bench(case) as bench:
            await bench.run(300)
            first = bench.hardware.numbers[0]
            bench.hardware.kill(first, bench.now_ns)
            await bench.run(20)
            bench.updates.clear()
            await bench.run(300)
            seen = Counter(bench.hardware.numbers[patch] for patch, _, _ in bench.updates)
            assert set(seen) == set(bench.hardware.numbers) - {first}

    play(scenario())


@pytest.mark.parametrize("case", CASES)
def test_a_driver_that_only_listens_sends_nothing(case: Case) -> None:
    hardware = case.devices(streaming=True)
    bus = VirtualCanBus.with_hardware(hardware, listen_only=True)
    with driving_lines([(case.adapter(), bus)], "listener", listen_only=True, wait=False) as running:
        running.ready.wait(5)
    assert bus.counters.sent == bus.counters.send_failures == 0
    assert hardware.totals()["commands"] == 0


# From the wire to a user program, in real time


@pytest.mark.parametrize("case", CASES)
def test_frames_hold_whole_bursts_in_order(case: Case) -> None:
    hardware = case.devices()
    expected = {number: case.expected(number, 2000) for number in hardware.numbers}
    with driving_lines([case.line(hardware)], "skin"):
        with DriverReader("skin") as reader:
            last = dict.fromkeys(hardware.numbers, 0)
            frames = reader.in_order(timeout_s=30)
            fresh = 0
            while fresh < 15:
                frame = next(frames)
                n_values = len(frame.values) // len(last)
                for at, number in enumerate(hardware.numbers):
                    part = slice(at * n_values, (at + 1) * n_values)
                    if frame.status[part].any():
                        continue
                    match = (expected[number][last[number] :] == frame.values[part]).all(axis=1)
                    assert match.any(), "values that no burst had, or had too long ago"
                    last[number] += int(match.argmax())
                    fresh += 1
            assert all(last.values())


@pytest.mark.parametrize("case", CASES)
def test_a_restarted_device_comes_back_by_itself(case: Case) -> None:
    hardware = case.devices(boot_s=0.5)
    adapter, bus = case.line(hardware)
    with driving_lines([(adapter, bus)], "skin") as running, DriverReader("skin") as reader:
        read_until(reader, lambda f: not f.status.any())
        first = hardware.numbers[0]
        running.do(lambda: hardware.restart(first, bus._clock()))
        n_values = case.n_shown
        stale = read_until(reader, lambda f: f.patch_state[0] != PatchState.LIVE and not f.status[n_values:].any())
        assert (stale.status[:n_values] & Status.STALE).all()
        read_until(reader, lambda f: f.patch_state[0] == PatchState.LIVE and not f.status.any())
