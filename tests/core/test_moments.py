"""The skin at a moment of the past, and the last seconds of several drivers on one time base."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Skin, Status, TimeWindow
from skinware.errors import ConfigurationError, StructureError
from skinware.realtime import now_ns
from tests.cli.fake_skin import fake_structure

MS = 1_000_000
STRUCTURE = fake_structure(1, 2)
"""20 taxels of pressure that count downwards: physical = 255 - raw."""


def publish(writer: DriverWriter, raw: int, time_ns: int, late: int = 0) -> None:
    """A sample whose second module has data ``late`` ns older than the first."""
    columns = writer.begin()
    columns["values"][:] = raw
    columns["status"][:] = 0
    columns["module_time_ns"][:] = time_ns, time_ns - late
    writer.commit(time_ns)


def test_a_moment_between_two_samples_is_interpolated_with_its_error() -> None:
    start_ns = now_ns() - 100 * MS
    with Skin() as skin, DriverWriter("arm", STRUCTURE, slots=8) as writer:
        for step in range(4):
            publish(writer, 100 + 20 * step, start_ns + 10 * MS * step)
        moment = skin.at(start_ns + 12 * MS)
        assert (moment.before.samples[0].sequence, moment.after.samples[0].sequence) == (2, 3)
        assert moment.nearest.physical("pressure").tolist() == [255 - 120] * 20
        assert np.allclose(moment.off_s("pressure"), -0.002)
        assert np.allclose(moment.physical("pressure"), 255 - 124)  # a fifth of the way from 120 to 140
        assert np.allclose(moment.error("pressure"), 16)  # four fifths
        assert moment.physical("pressure").dtype == np.float32
        assert moment.fresh("pressure").all()
        assert skin.at(start_ns + 18 * MS).nearest.samples[0].sequence == 3
        with pytest.raises(StructureError, match="no sensor type 'force'"):
            moment.physical("force")


def test_each_sensor_is_interpolated_by_the_time_of_its_own_data() -> None:
    start_ns = now_ns() - 100 * MS
    with Skin() as skin, DriverWriter("arm", STRUCTURE, slots=8) as writer:
        publish(writer, 100, start_ns, late=4 * MS)
        publish(writer, 200, start_ns + 10 * MS, late=4 * MS)
        physical = skin.at(start_ns + 5 * MS).physical("pressure")
        assert np.allclose(physical[:10], 255 - 150)
        assert np.allclose(physical[10:], 255 - 190)  # 9 of 10 ms after its data
        assert np.allclose(skin.at(start_ns + 8 * MS).physical("pressure")[10:], 255 - 200)  # data of 6 ms: not beyond


def test_outside_the_ring_the_nearest_sample_is_all_there_is() -> None:
    start_ns = now_ns() - 2000 * MS
    with Skin() as skin, DriverWriter("arm", STRUCTURE, slots=8, rate_hz=100) as writer:
        for step in range(20):
            publish(writer, step, start_ns + 10 * MS * step)
        early, late = skin.at(start_ns), skin.at(now_ns())
        oldest = early.nearest.samples[0].sequence
        assert early.before.samples[0].sequence == oldest > 10
        assert np.allclose(early.off_s("pressure"), (oldest - 1) * 0.01)
        assert (early.error("pressure") == 0).all()
        assert late.nearest.samples[0].sequence == 20
        assert early.fresh("pressure").all()  # 0.13 s away, and 0.2 s is the limit
        assert not late.fresh("pressure").any()


def test_a_moment_of_a_bad_value_is_not_fresh() -> None:
    start_ns = now_ns() - 100 * MS
    with Skin() as skin, DriverWriter("arm", STRUCTURE, slots=8) as writer:
        publish(writer, 1, start_ns)
        columns = writer.begin(from_last=True)
        columns["status"][3] = Status.STALE
        columns["module_time_ns"][1] = 0
        writer.commit(start_ns + 10 * MS)
        moment = skin.at(start_ns + 6 * MS)
        assert np.flatnonzero(~moment.fresh("pressure")).tolist() == [3, *range(10, 20)]
        assert np.isnan(moment.off_s("pressure")[10:]).all()


def test_a_moment_to_come_is_waited_for() -> None:
    with Skin() as skin, DriverWriter("arm", STRUCTURE, slots=8) as writer:
        publish(writer, 1, now_ns())
        moment = skin.at(now_ns() + 30 * MS, timeout_s=0.05)
        assert moment.after is not moment.before
        assert moment.after.samples[0].sequence == 1  # nothing came: the nearest there is


def test_two_drivers_of_different_rates_on_one_time_base() -> None:
    start_ns = now_ns() - 500 * MS
    window = TimeWindow("pressure", 0.2, rate_hz=50)
    with (
        Skin() as skin,
        DriverWriter("fast", STRUCTURE, rate_hz=100) as fast,
        DriverWriter("slow", STRUCTURE, rate_hz=25) as slow,
    ):
        for step in range(50):
            publish(fast, step, start_ns + 10 * MS * step)
            if step % 4 == 0 and not 28 <= step < 40:
                publish(slow, 100 + step, start_ns + 10 * MS * step)
            if len(skin.refresh().drivers) == 2:
                window.add(skin.read())
        rows = window.rows(start_ns + 480 * MS)
        assert rows.time_ns.tolist() == [start_ns + MS * (480 - 20 * back) for back in range(9, -1, -1)]
        assert rows.physical.shape == rows.mask.shape == (10, 40)
        steps = np.arange(30, 49, 2)
        assert (rows.physical[:, 0] == 255 - steps).all()
        assert np.allclose(rows.off_s[:, 0], 0)
        assert rows.mask[:, :20].all()
        slow_mask = rows.mask[:, 20]  # samples at 240, then from 400 ms on, 40 ms apart
        assert slow_mask.tolist() == [False] * 3 + [True] * 7
        assert (rows.physical[slow_mask, 20] == 255 - (100 + np.array([40, 40, 40, 40, 44, 44, 48]))).all()
        assert window.rows().time_ns[-1] == start_ns + 480 * MS  # which both have reached


def test_a_window_begins_again_with_other_drivers() -> None:
    window = TimeWindow("pressure", 0.1, rate_hz=10)
    with pytest.raises(ConfigurationError, match="add a snapshot first"):
        window.rows()
    with pytest.raises(ConfigurationError, match="has no row"):
        TimeWindow("pressure", 0.01, rate_hz=10)
    with Skin() as skin, DriverWriter("arm", STRUCTURE) as arm:
        publish(arm, 1, now_ns())
        window.add(skin.read())
        assert window.rows().physical.shape == (1, 20)
        with DriverWriter("hand", STRUCTURE) as hand:
            publish(hand, 2, now_ns())
            skin.refresh()
            window.add(skin.read())
            assert window.rows().physical.tolist() == [[254.0] * 20 + [253.0] * 20]


def test_the_latest_sample_is_there_at_once_or_none() -> None:
    with Skin() as skin, DriverWriter("arm", STRUCTURE) as arm, DriverReader("arm") as reader:
        assert skin.latest() is None
        assert reader.latest() is None
        publish(arm, 7, now_ns())
        skin.refresh()
        first, snapshot = reader.latest(), skin.latest()
        assert first is not None
        assert snapshot is not None
        assert (first.sequence, snapshot.samples[0].sequence) == (1, 1)
        again = reader.latest()
        assert again is not None
        assert again.position == first.position
        arm.close()
        last = reader.latest()
        assert last is not None
        assert last.stale
