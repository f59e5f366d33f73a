"""The firmware of docs/how-to/openpatch.md, compiled as it stands there, runs and is read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from skinware import Skin
from tests.openpatch.microcontroller import HERE, Microcontroller, program
from tests.sdk.driving import driving_lines

PAGE = Path(__file__).parents[2] / "docs/how-to/openpatch.md"


@pytest.mark.thorough
def test_the_sketch_of_the_page_is_a_patch(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    sketch = re.search(r"```cpp\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert sketch
    source = tmp_path / "sketch.ino"
    source.write_text(sketch[1])
    firmware = program(source, "c++11", tmp_path_factory, "-include", str(HERE / "arduino/Arduino.h"))
    with Microcontroller(firmware, "") as patch, driving_lines([patch.line()], "openpatch"), Skin() as skin:
        snapshot = skin.read(timeout_s=30)
        assert snapshot.physical("pressure").tolist() == pytest.approx([10, 20, 30, 40])
        assert snapshot.physical("temperature").tolist() == [105]
