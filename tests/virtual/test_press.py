"""What small emulated devices feel."""

from __future__ import annotations

import numpy as np

from skinware_drivers.virtual import on_a_grid
from skinware_drivers.virtual.emulator import WanderingPress


def test_a_device_is_touched_and_then_rests_for_longer_than_a_baseline_takes() -> None:
    press = WanderingPress(0, 1, on_a_grid(16, 4))
    times_s = np.arange(0, 65, 0.1)
    is_touched = np.array([press.strength(time_s).max() > 0 for time_s in times_s])
    ends_s = times_s[1:][np.diff(is_touched.astype(int)) == -1]
    begins_s = times_s[1:][np.diff(is_touched.astype(int)) == 1]
    rests_s = [begins_s[begins_s > end_s][0] - end_s for end_s in ends_s if (begins_s > end_s).any()]
    assert sum(rest_s > 6 for rest_s in rests_s) == 2
    assert min(np.diff(ends_s)) > 3
    assert len(ends_s) >= 12
