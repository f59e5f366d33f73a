"""The suite on many modules: ranges of each channel, shifted keys, samples of unused frames."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.options import NoOptions
from skinware_drivers.testing.conformance import DriverConformance
from skinware_drivers.testing.rig import extreme, lively
from skinware_drivers.testing.vectors import decode_frames
from skinware_drivers.virtual import EmulatorOptions
from tests.testing.cells import DATA, Cells, ElevenBits, EmulatedCells, NoTemperatures, ShiftedKeys

VALUES = "test_every_value_is_right_and_in_order"


class TestCells(DriverConformance):
    """The right driver has no defect."""

    driver = Cells
    emulator = EmulatedCells


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("driver", "words"),
    [
        (
            ShiftedKeys,
            r"modules 0 to 18 \('skin'\) received what modules 1 to 19 \('skin'\) sent: the keys",
        ),
        (NoTemperatures, r"'bad_length': \d+}; for example bad_length 18D0..02 \[4\] .. .. .. ..,"),
        (
            NoTemperatures,
            r"\nFrames 'part 2' have length 2, but 4 bytes came \(18D0..02 \[4\] .. .. .. ..\)\.\nNo frame",
        ),
        (
            ElevenBits,
            r"\nHeard 0x18D0.... \(29 bits\) where the layout has only identifiers of 11 bits: write EXTENDED_FLAG \|",
        ),
    ],
)
@pytest.mark.usefixtures("namespace")
def test_it_is_named(driver: type[AnyAdapter], words: str) -> None:
    suite = TestCells()
    suite.driver = driver  # type: ignore[misc, assignment]
    with pytest.raises(pytest.fail.Exception, match=words):
        getattr(suite, VALUES)()


def test_each_value_has_a_range_of_its_own() -> None:
    for pattern in (lively, extreme):
        felt = np.array([pattern(EmulatedCells)(0, cycle, 200) for cycle in range(60)]).reshape(60, 20, 10)
        assert felt[:, :, :9].max() > 4000
        assert (felt[:, :, 9] >= 100).all()
        assert (felt[:, :, 9] <= 1023).all()


@pytest.mark.parametrize(("pattern", "least", "most"), [("idle", 512, 512), ("touch", 512, 562), ("cycle", 0, 1023)])
def test_what_is_felt_keeps_to_it(pattern: str, least: int, most: int) -> None:
    cells = EmulatedCells(EmulatorOptions(pattern=pattern))  # type: ignore[arg-type]
    cells.skip(0)
    warm = [int.from_bytes(f.payload[2:], "little") for f in cells.emit(3_000_000_000) if len(f.payload) == 4]
    assert warm
    assert least <= min(warm) <= max(warm) <= most


def test_a_range_for_another_number_of_values_is_refused() -> None:
    class Wrong(EmulatedCells):
        rest = (1, 2, 3)

    cells = Wrong(EmulatorOptions(pattern="idle"))
    cells.skip(0)
    with pytest.raises(ConfigurationError, match="rest has 3 numbers, `places` has 200 values"):
        cells.emit(1_000_000_000)


def test_literal_frames_of_29_bits() -> None:
    shown = decode_frames(
        Cells(NoOptions()),
        [
            (DATA | 0x200, "01 00 02 00 03 00 04 00"),
            (DATA | 0x201, bytes(8)),
            (EXTENDED_FLAG | 0x18D00202, "09 00 07 00"),
        ],
    )
    assert shown.values[10:20].tolist() == [1, 2, 3, 4, 0, 0, 0, 0, 9, 7]
    assert shown.never_seen.sum() == 190
