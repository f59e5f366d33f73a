"""``skin-doctor`` examines snapshots with any contents."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skinware.realtime import now_ns
from skinware_drivers.cli.doctor import as_text
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.recorded import look_at
from skinware_drivers.doctor.report import Secrets, as_markdown
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.doctor.rig import looked
from tests.recording.rig import has, recording


class _Garbage(FakeSkin):
    """A driver of a version to come, or a hostile one: bytes at random in every column."""

    generator = np.random.default_rng(3)

    def publish(self, count: int = 1) -> None:
        for _ in range(count):
            for column in self.writer.begin().values():
                raw = column.view(np.uint8).reshape(-1)
                raw[:] = self.generator.integers(0, 256, len(raw))
            self.writer.commit(now_ns())


@pytest.mark.parametrize("dtype", ["u1", "<i4", "<f4"])
def test_no_contents_of_frames_are_too_much(dtype: str, tmp_path: Path) -> None:
    file = tmp_path / "garbage.mcap"
    with publishing(_Garbage("torso", fake_structure(2, 2, dtype=dtype))):
        with recording(file) as recorder:
            has(recorder, "torso")
            seen = looked()
        for evidence in (seen, look_at(file)):
            told = examine(evidence)
            assert told.findings
            text = as_text(evidence, told)
            assert text
            assert as_markdown(text, evidence.drivers, Secrets())
