"""Tests of the driver: what every driver must do, and what only this one does."""

from __future__ import annotations

import pytest
from skinware import Status
from skinware.errors import ConfigurationError
from skinware_drivers.options import options_from_strings
from skinware_drivers.testing.conformance import DriverConformance
from skinware_drivers.testing.vectors import decode_stream

from optoforce.driver import SETTINGS, OptoforceDriver, OptoforceOptions
from optoforce.emulator import EmulatedOptoforce


class TestOneSensor(DriverConformance):
    """The converter with one sensor."""

    driver = OptoforceDriver
    emulator = EmulatedOptoforce


class TestFourSensors(DriverConformance):
    """The converter with four sensors, faster."""

    driver = OptoforceDriver
    emulator = EmulatedOptoforce
    driver_options = {"model": "four", "period_ms": 3}
    emulator_options = {"sensors": 4}


def one() -> OptoforceDriver:
    """A driver of one sensor."""
    return OptoforceDriver(OptoforceOptions())


def test_a_sample_of_one_sensor() -> None:
    """By hand: x = 1, y = -2, z = 16037 (which is 40 N on one of these sensors)."""
    shown = decode_stream(one(), "AA 07 08 0A 00 01 00 00 00 01 FF FE 3E A5 03 A5")
    assert shown.values.tolist() == [1, -2, 16037]
    assert not shown.status.any()
    assert [t.name for t in shown.structure.types] == ["shear_x", "shear_y", "pressure"]


def test_a_sample_with_a_wrong_sum_is_not_shown() -> None:
    """One bit is enough."""
    shown = decode_stream(one(), "AA 07 08 0A 00 01 00 00 00 01 FF FE 3E A5 03 A4", strict=False)
    assert shown.never_seen.all()
    assert shown.problems[0] == "1 x the checksum is wrong"


@pytest.mark.parametrize(
    ("packet", "status"),
    [
        ("AA 07 08 0A 00 01 02 00 00 00 00 00 00 00 00 C6", [Status.OUT_OF_RANGE, 0, 0]),
        ("AA 07 08 0A 00 01 00 80 00 00 00 00 00 00 01 44", [0, 0, Status.OUT_OF_RANGE]),
        ("AA 07 08 0A 00 01 08 00 00 00 00 00 00 00 00 CC", [Status.SUSPECT] * 3),
        ("AA 07 08 0A 00 01 20 00 00 00 00 00 00 00 00 E4", [Status.SUSPECT] * 3),
    ],
)
def test_the_status_word_marks_what_it_is_about(packet: str, status: list[int]) -> None:
    """Too much force in x and in z, a sensor that fails, a converter that fails."""
    assert decode_stream(one(), packet).status.tolist() == status


def test_the_settings_are_sent_as_published() -> None:
    """100 Hz, filter of 15 Hz, no new zero."""
    assert SETTINGS.encode(0, bytes([10, 4, 0])) == bytes.fromhex("AA 00 32 03 0A 04 00 00 ED")


@pytest.mark.parametrize("text", [{"period_ms": "20"}, {"model": "two"}, {"filter_hz": "16"}])
def test_settings_that_the_converter_does_not_have_are_refused(text: dict[str, str]) -> None:
    """With a message that names the option."""
    with pytest.raises(ConfigurationError, match=next(iter(text))):
        options_from_strings(OptoforceOptions, text)
