"""The suite finds the defects of a driver, and names them in words."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator

import pytest

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.testing import waiting
from skinware_drivers.testing.conformance import DriverConformance
from skinware_drivers.testing.waiting import wait_until
from tests.testing import fingertips as f

VALUES = "test_every_value_is_right_and_in_order"
DAMAGE = "test_a_damaged_frame_costs_its_own_burst_only"
DEFECTS: list[tuple[type[AnyAdapter], str, tuple[str, ...], str]] = [
    (f.SwappedBytes, VALUES, (), r"12 of 12 sensors .*(?s:.*)two bytes swapped — look at the byte order"),
    (f.Signed, VALUES, (), r"the unsigned value as if it were signed — look at the sign of the dtype"),
    (f.Signed, "test_extreme_values", (), r"the unsigned value as if it were signed"),
    (f.OneByteEarly, VALUES, (), r"bytes of two values — look at `offset`|one byte off"),
    (
        f.NextTaxel,
        VALUES,
        (),
        r"taxel 0 .*shows what finger 1, taxel 5(?s:.*)taxel 1 .*what finger 1, taxel 0 .*off by -1",
    ),
    (
        f.WrongPermutation,
        VALUES,
        (),
        r"4 of 12 sensors(?s:.*)finger 1, taxel 0 .*shows what finger 1, taxel 2 .*look at `offset` and `to`",
    ),
    (
        f.TwoOnOne,
        VALUES,
        (),
        r"2 of 12 declared sensors: was never seen: finger 1, taxel 2 (?s:.*)two channels `to` one",
    ),
    (
        f.ForgottenFrame,
        VALUES,
        (),
        r"6 of 12 declared sensors: was never seen: finger 1, taxel 3 (?s:.*)a frame.*missing",
    ),
    (
        f.WrongLength,
        VALUES,
        (),
        r"\nFrames 'proximal' have length 8 or 64, but 7 bytes came \(10\d \[7\] 00 .*\)\.\n",
    ),
    (
        f.HalvesApart,
        "test_nothing_torn_is_shown_while_a_sender_stumbles",
        (),
        r"updates show values that were never sent together",
    ),
    (
        f.TakesForeignFrames,
        "test_foreign_frames_disturb_nothing",
        (),
        r"frames of other devices came, \d+ were counted",
    ),
    (
        f.FilledIn,
        "test_nothing_is_valid_before_the_first_data",
        (),
        r"sensors without a frame of theirs were filled in",
    ),
    (f.RaisesOnGarbage, "test_garbage_raises_nothing", (), r"Expand function raised ValueError: there is no such half"),
    (
        f.AnyLength,
        DAMAGE,
        ("truncated",),
        r"frames were truncated on the wire: \d+ updates show values that were never",
    ),
    (
        f.MissingModule,
        "test_the_description_is_valid_complete_and_stable",
        (),
        r"declares 6 sensors, the devices have 12",
    ),
    (f.SameUids, "test_the_description_is_valid_complete_and_stable", (), r"the description is not valid: .*uid"),
    (
        f.NoMatrix,
        "test_the_description_is_valid_complete_and_stable",
        (),
        r"'finger 1' is called a matrix \(2x3\), but by `geometry` its pressure sensors go to and fro along a row",
    ),
    (
        f.ChangesItsMind,
        "test_the_description_is_valid_complete_and_stable",
        (),
        r"returns another structure for the same devices",
    ),
    (f.WrongPeriod, "test_the_rate_is_the_declared_one", (), r"`period_s` is 0.04 s, but device 1 sends every 0.02 s"),
    (f.Sleeps, VALUES, (), r"blocks: .*fingertips.py:\d+, in start, calls time.sleep\(0.01\)"),
    (f.Hangs, VALUES, (), r"blocks, nothing is read(?s:.*)go_on.wait"),
    (f.WaitsForEver, "test_devices_that_come_late_are_found", (), r"nothing was published .*the devices sent no frame"),
    (f.LeaksDescriptors, "test_nothing_leaks", (), r"left behind after .*descriptor \d+ \(/\)"),
    (f.LeaksThreads, "test_nothing_leaks", (), r"left behind after .*thread 'forgotten'"),
    (f.LeaksTasks, VALUES, (), r"a task was left running at the end: .*sleep"),
    (f.LeaksMemory, "test_memory_does_not_grow", (), r"memory grows with the data: \d+ pieces more.*fingertips.py"),
    (f.TalksWhenItShouldListen, "test_a_listener_sends_nothing", (), r"may only listen, and tried to send \d+ frames"),
    (
        f.NeverStops,
        "test_devices_are_silent_again_after_stop",
        (),
        r"continue to send .* `stop` does not make them silent",
    ),
    (f.IgnoresRestarts, "test_restarted_devices_come_back", (), r"lost its power .*look at `probe` and `revive`"),
    (f.RaisesOnStop, "test_handshakes_in_any_order", (), r"`stop` raised AttributeError: .*only BusError may be"),
]


class TestFingertips(DriverConformance):
    """The right driver has no defect."""

    driver = f.Fingertips
    emulator = f.EmulatedFingertips


class TestCounting(DriverConformance):
    """Nor has one of fingertips that count."""

    driver = f.Counting
    emulator = f.EmulatedCounting


@pytest.fixture
def tidy() -> Iterator[None]:
    """End the threads and tasks that defective drivers leave."""
    f.Hangs.go_on.clear()
    f.Computes.enough.clear()
    f.LeaksThreads.end.clear()
    yield
    f.Hangs.go_on.set()
    f.Computes.enough.set()
    f.LeaksThreads.end.set()
    while f.LeaksDescriptors.leaked:
        os.close(f.LeaksDescriptors.leaked.pop())
    mine = ("forgotten", "driver under test")
    wait_until(lambda: not any(thread.name in mine for thread in threading.enumerate()))


@pytest.mark.thorough
@pytest.mark.usefixtures("tidy")
@pytest.mark.parametrize(
    ("driver", "test", "arguments", "words"),
    [pytest.param(*defect, id=f"{defect[0].__name__}-{defect[1][5:]}") for defect in DEFECTS],
)
def test_it_is_found_and_named(driver: type[AnyAdapter], test: str, arguments: tuple[str, ...], words: str) -> None:
    suite = TestFingertips()
    suite.driver = driver  # type: ignore[misc, assignment]
    with pytest.raises(pytest.fail.Exception, match=words):
        getattr(suite, test)(*arguments)


@pytest.mark.thorough
@pytest.mark.usefixtures("tidy", "namespace")
def test_a_driver_that_computes_without_end_is_found_by_its_processor_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "_LONGEST_TURN_S", 0.5)
    suite = TestFingertips()
    suite.driver = f.Computes  # type: ignore[misc]
    with pytest.raises(pytest.fail.Exception, match=r"loops without end, here:(?s:.*)fingertips.py(?s:.*)enough"):
        getattr(suite, VALUES)()
    f.Computes.enough.set()


@pytest.mark.parametrize("test", [VALUES, "test_extreme_values"])
def test_signs(test: str) -> None:
    suite = TestFingertips()
    suite.emulator, suite.driver = f.EmulatedSigned, f.Signed  # type: ignore[misc]
    getattr(suite, test)()
    suite.driver = f.Fingertips  # type: ignore[misc]
    with pytest.raises(pytest.fail.Exception, match="the signed value as if it were unsigned"):
        getattr(suite, test)()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("driver", "emulator", "test", "words"),
    [
        (
            f.Counting,
            f.EmulatedStill,
            "test_no_run_of_lost_frames_tears_a_burst",
            r"the `counter` of the cycle is 5 in all frames of 8 bursts.*look at its `offset`",
        ),
        (
            f.CountsPressures,
            f.EmulatedCounting,
            VALUES,
            r"\n\d+ frames found no partners: .*with the same number, if it has a `counter`",
        ),
    ],
)
@pytest.mark.usefixtures("namespace")
def test_a_counter_that_does_not_count_is_named(
    driver: type[AnyAdapter], emulator: type[f.EmulatedFingertips], test: str, words: str
) -> None:
    suite = TestFingertips()
    suite.driver, suite.emulator = driver, emulator  # type: ignore[misc, assignment]
    with pytest.raises(pytest.fail.Exception, match=words):
        getattr(suite, test)()


@pytest.mark.parametrize("real_s", [0.0083, 0.01, 0.0125, 0.05])
@pytest.mark.usefixtures("namespace")
def test_the_period_that_is_measured_is_the_real_one(real_s: float) -> None:
    suite = TestFingertips()
    suite.emulator = type("Emulated", (f.EmulatedFingertips,), {"period_s": real_s})  # type: ignore[misc, assignment]
    with pytest.raises(pytest.fail.Exception, match=r"`period_s` is 0.02 s, but device 1 sends every") as raised:
        suite.test_the_rate_is_the_declared_one()
    (told,) = re.findall("sends every (.*) s", str(raised.value))
    assert float(told) == pytest.approx(real_s, rel=0.02)
