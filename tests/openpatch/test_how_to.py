"""The firmware that docs/how-to/openpatch.md shows runs and is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinware import Skin
from tests.openpatch.microcontroller import HERE, Microcontroller, program
from tests.sdk.driving import driving_lines

SKETCH = Path(__file__).parents[2] / "examples/my_patch/my_patch.ino"


@pytest.mark.thorough
def test_the_sketch_of_the_page_is_a_patch(tmp_path_factory: pytest.TempPathFactory) -> None:
    firmware = program(SKETCH, "c++11", tmp_path_factory, "-include", str(HERE / "arduino/Arduino.h"))
    with Microcontroller(firmware, "") as patch, driving_lines([patch.line()], "openpatch"), Skin() as skin:
        snapshot = skin.read(timeout_s=30)
        assert snapshot.physical("pressure").tolist() == pytest.approx([10, 20, 30, 40])
        assert snapshot.physical("temperature").tolist() == [105]
