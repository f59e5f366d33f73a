"""A test of a defective driver ends soon and says what it saw; tests of values come first."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from skinware import DriverReader
from skinware.status import Unused
from skinware_drivers.testing.fault_tests import SilenceTests
from skinware_drivers.testing.waiting import read_until
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.testing import test_cells


def test_it_waits_for_seconds_not_for_frames_and_says_what_it_saw() -> None:
    with FakeSkin("torso", fake_structure(2, 4, buses=2)) as skin, DriverReader("torso") as reader:
        skin.break_some()
        skin.bus_samples[0][0] = (0x98DA00F1, 8, Unused.UNKNOWN, 0, range(1, 9))
        skin.publish(3)
        begun = time.monotonic()
        with pytest.raises(pytest.fail.Exception) as told:
            read_until(reader, lambda frame: not frame.status.any(), 0.5)
        assert time.monotonic() - begun >= 0.5
    words = str(told.value)
    assert "frames of 0.5 s fulfils" in words
    assert "in the last, 41 of 96 sensors are fresh, 1 NEVER_SEEN, 52 STALE" in words
    assert "unknown: 7, for example 18DA00F1 [8] 01 02 03 04 05 06 07 08" in words


@pytest.mark.thorough
def test_values_are_tested_first_and_silence_last() -> None:
    """With ``pytest -x``, the byte order is reported, and not a silence that follows from it."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", test_cells.__file__]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    names = [line.rpartition("::")[2] for line in told.splitlines() if "::TestCells::" in line]
    assert names[0] == "test_every_value_is_right_and_in_order"
    silence = [name for name in vars(SilenceTests) if name.startswith("test_")]
    assert names[-len(silence) :] == silence
