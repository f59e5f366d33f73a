"""Test a driver with captures of real devices: a folder of files, and a test for each.

::

    class TestCaptures(CaptureTests):
        driver = MyDriver
        folder = Path(__file__).parent / "captures"

``skin-driver --capture FILE`` writes a capture. The test fails if the driver decodes it to other values than expected:
those in the file beside it (``hand.npz`` for ``hand.mcap``, from ``skin-prove --captured hand.mcap --save``), or else
those that were decoded during the capture.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import pytest

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.proving.captures import check_capture
from skinware_drivers.testing.waiting import require


class CaptureTests:
    """One test for each capture in a folder.

    Attributes:
        driver_options: options in place of those that the driver had during the capture.
    """

    driver: ClassVar[type[AnyAdapter]]
    folder: ClassVar[Path]
    driver_options: ClassVar[Mapping[str, Any]] = {}

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Make a test of each capture (a hook of pytest)."""
        if "capture" in metafunc.fixturenames:
            files = sorted(self.folder.rglob("*.mcap"))
            metafunc.parametrize("capture", files, ids=[str(file.relative_to(self.folder)) for file in files])

    def test_the_driver_makes_of_it_what_is_expected(self, capture: Path) -> None:
        """Every value of every update is the expected one."""
        compared, _ = check_capture(capture, self.driver, self.driver_options)
        require(
            compared.then,
            f"{capture}: nothing was decoded then; check what is decoded now, and save it (skin-prove)",
        )
        require(compared.difference is None, f"{capture}: {compared.difference}")
