"""Tests of a driver by captures of real devices: a folder of files, and a test for each.

::

    class TestCaptures(CaptureTests):
        driver = MyDriver
        folder = Path(__file__).parent / "captures"

A capture is what ``skin-driver --capture FILE`` leaves. The test fails if the driver does not make of it what is
expected: what is in the file beside it (``hand.npz`` of ``hand.mcap``, by ``skin-prove --captured hand.mcap --save``),
or else what was decoded when it was captured.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import pytest

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.proving.captures import check_capture
from skinware_drivers.testing.defect import require


class CaptureTests:
    """One test for each capture in a folder.

    Attributes:
        driver: the class of the driver.
        folder: where the captures are, also in folders in it.
        driver_options: beside those that the driver had when it was captured.
    """

    driver: ClassVar[type[AnyAdapter]]
    folder: ClassVar[Path]
    driver_options: ClassVar[Mapping[str, Any]] = {}

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Called by pytest."""
        if "capture" in metafunc.fixturenames:
            files = sorted(self.folder.rglob("*.mcap"))
            metafunc.parametrize("capture", files, ids=[str(file.relative_to(self.folder)) for file in files])

    def test_the_driver_makes_of_it_what_is_expected(self, capture: Path) -> None:
        """Every value, of every update."""
        compared, _ = check_capture(capture, self.driver, self.driver_options)
        require(compared.then, f"{capture}: nothing was decoded then; look at what is now, and save it (skin-prove)")
        require(compared.difference is None, f"{capture}: {compared.difference}")
