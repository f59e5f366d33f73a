"""The clock of a device in C and as specified: the same times, and the same knowledge, bit by bit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware.memory.namespace import Namespace
from skinware.sensor_types import PRESSURE
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.fields import DeviceTime, Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.native.device_time import DeviceClock
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.device_time import SpecifiedClock

S, MS = 1_000_000_000, 1_000_000
Times = npt.NDArray[np.int64]
CLOCKS = [(1e-6, 1 << 32), (1e-3, 1 << 16), (1e-4, 60_000), (1.0, 1 << 32), (1e-3, 7), (1e-9, 1 << 62)]


@dataclass(frozen=True)
class Stretch:
    """Frames of a device that behaves in one way.

    Attributes:
        n: how many.
        period_ns: from one to the next.
        rate: of the device's clock, 1: right, 0: it stands still.
        jump_ns: of the device's clock, before the first of them.
        pause_ns: without frames, before the first of them.
        held_up: frames that are received together.
        twice: every so many frames, one is sent twice; 0: never.
    """

    n: int
    period_ns: int
    rate: float
    jump_ns: int
    pause_ns: int
    held_up: int
    twice: int


stretches = st.builds(
    Stretch,
    n=st.integers(1, 300),
    period_ns=st.sampled_from([0, MS, 5 * MS, 20 * MS, 300 * MS, 2 * S]),
    rate=st.sampled_from([1.0, 1.0, 1.0001, 0.9998, 1.01, 0.5, 0.0, -1.0]),
    jump_ns=st.sampled_from([0, 0, 0, 40 * MS, 60 * MS, -3 * MS, -10 * S, 1000 * S]),
    pause_ns=st.sampled_from([0, 0, 0, 3 * S, 15 * S, 70 * S]),
    held_up=st.sampled_from([1, 1, 7, 150]),
    twice=st.sampled_from([0, 0, 3]),
)


def play(script: list[Stretch], unit_s: float, modulo: int, seed: int) -> tuple[Times, Times]:
    """Return (n,) stamps and (n,) times of receipt, ns."""
    random = np.random.default_rng(seed)
    true_ns, device_ns, latest_ns = 5_000 * S, float(random.integers(0, 100_000 * S)), 0
    stamps, received = [], []
    for stretch in script:
        true_ns += stretch.pause_ns
        device_ns += stretch.pause_ns * stretch.rate + stretch.jump_ns
        for number in range(stretch.n):
            last = number - number % stretch.held_up + stretch.held_up - 1
            delay_ns = (last - number) * stretch.period_ns + 200_000 + int(random.exponential(300_000))
            latest_ns = max(latest_ns, true_ns + delay_ns)
            is_twice = bool(stretch.twice) and number % stretch.twice == 0
            stamps += [int(device_ns / S / unit_s) % modulo] * (1 + is_twice)
            received += [latest_ns] * (1 + is_twice)
            true_ns += stretch.period_ns
            device_ns += stretch.period_ns * stretch.rate
    return np.array(stamps, np.int64), np.array(received, np.int64)


def known(clock: DeviceClock) -> dict[str, float]:
    return {name: getattr(clock.state, name) for name in SpecifiedClock(1.0).known()}


@settings(max_examples=60, deadline=None)
@given(
    script=st.lists(stretches, min_size=1, max_size=8),
    kind=st.sampled_from(CLOCKS),
    part_ns=st.sampled_from([S, S // 4]),
    seed=st.integers(0, 1000),
    cut=st.integers(1, 400),
)
def test_c_and_the_specification_agree_however_frames_are_cut_into_batches(
    script: list[Stretch], kind: tuple[float, int], part_ns: int, seed: int, cut: int
) -> None:
    stamps, received = play(script, *kind, seed)
    specified = SpecifiedClock(*kind, part_ns=part_ns)
    cut_up, whole = (DeviceClock(*kind, part_ns=part_ns) for _ in range(2))
    times = []
    for at in range(0, len(stamps), cut):
        batch = slice(at, at + cut)
        times += specified.convert(stamps[batch], received[batch]).tolist()
        assert cut_up.convert(stamps[batch], received[batch]).tolist() == times[at:]
        assert known(cut_up) == specified.known()
    assert whole.convert(stamps, received).tolist() == times
    assert known(whole) == known(cut_up)
    assert (np.diff(times) >= 0).all()
    assert (np.array(times) <= received).all()


def test_a_long_life_agrees() -> None:
    script = [
        Stretch(9000, 10 * MS, 1.00005, 0, 0, 7, 0),
        Stretch(60, 100 * MS, 0.0, 0, 0, 1, 0),
        Stretch(2000, 50 * MS, 0.9998, -20 * S, 0, 1, 3),
    ]
    stamps, received = play(script, 1e-3, 1 << 16, 4)
    clock, specified = DeviceClock(1e-3, 1 << 16), SpecifiedClock(1e-3, 1 << 16)
    assert clock.convert(stamps, received).tolist() == specified.convert(stamps, received).tolist()
    assert known(clock) == specified.known()
    assert clock.state.stops > 0
    assert clock.state.drift == pytest.approx(2e-4, abs=2e-5)


def test_a_stop_is_named_once_and_a_patch_is_forgotten(namespace: Namespace, caplog: pytest.LogCaptureFixture) -> None:
    """Two patches on two buses; the clock of the second one stops."""
    frame = Frame("one", [Identifier(1)], [8], Values(0, "<u2", 2), time=DeviceTime(4, "<u2", 1e-3))
    tip = Patch("tip", [Module(taxels(2))])
    tables = assemble([("b0", [tip]), ("b1", [tip])], [PRESSURE], np.uint16)

    def send(time_ns: int, stamp: int) -> None:
        pair.clock.now_ns = max(pair.clock.now_ns, time_ns)
        stamps = (time_ns // MS & 0xFFFF, stamp & 0xFFFF)
        pair.feed([(bus, time_ns, 1, bytes(4) + each.to_bytes(4, "little")) for bus, each in enumerate(stamps)])

    with hand_clock() as clock, Pair(clock, [Layout([frame])] * 2, tables, [1.0] * 2, namespace=namespace) as pair:
        begin_ns = clock.now_ns + S
        for number in range(8):
            send(begin_ns + number * S, 0)
        state, late_ns = pair.native.decoder.state, begin_ns + 9 * S
        send(begin_ns + 8 * S + 100 * MS, 1100)  # it goes again
        send(late_ns, 1200)
        assert late_ns - state.patch_time_ns[1] > 500 * MS
        pair.do(lambda way: way.decoder.forget(1))
        send(late_ns + MS, 1201)
        assert state.patch_time_ns[1] == late_ns + MS
    warnings = [record.message for record in caplog.records if "stands still" in record.message]
    assert [warning.split(" stands still")[0] for warning in warnings] == ["b1: the clock of tip"] * 2
