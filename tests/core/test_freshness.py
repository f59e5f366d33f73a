"""Age is part of fresh: for one driver, for the whole skin, and while waiting."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Skin, Status
from skinware.errors import ServiceTimeout
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import age_limit_ns, is_fresh
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import fake_process, fake_structure

MS = 1_000_000


def publish(writer: DriverWriter, *, age_ns: int = 0, status: int = 0) -> None:
    time_ns = now_ns() - age_ns
    columns = writer.begin()
    columns["values"][:] = 7
    columns["status"][:] = status
    columns["module_time_ns"][:] = time_ns
    writer.commit(time_ns)


@pytest.mark.parametrize(
    ("period_ns", "limit_ns"), [(0, NS_PER_S), (5 * MS, 200 * MS), (50 * MS, 200 * MS), (100 * MS, 300 * MS)]
)
def test_the_limit_is_three_periods_and_never_too_tight(period_ns: int, limit_ns: int) -> None:
    assert age_limit_ns(period_ns) == limit_ns


def test_fresh_takes_status_age_and_life_together() -> None:
    status = np.array([0, 0, 0, 0, Status.STALE, Status.SUSPECT], np.uint8)
    time_ns = np.array([900, 800, 799, 0, 900, 900], np.int64)
    assert is_fresh(status, time_ns, at_ns=900, max_age_ns=100).tolist() == [True, True, *[False] * 4]
    assert is_fresh(status, time_ns, at_ns=50, max_age_ns=100).tolist() == [True, True, True, *[False] * 3]
    assert not is_fresh(status, time_ns, at_ns=900, max_age_ns=100, alive=False).any()


def test_a_stamp_in_the_future_is_not_fresh() -> None:
    status = np.zeros(3, np.uint8)
    time_ns = np.array([900, 900 + 200 * MS, 901 + 200 * MS], np.int64)
    assert is_fresh(status, time_ns, at_ns=900, max_age_ns=100).tolist() == [True, True, False]
    with DriverWriter("a", fake_structure(1, 2), rate_hz=10) as writer, DriverReader("a") as reader:
        publish(writer, age_ns=-3600 * NS_PER_S)
        assert not reader.read().fresh("pressure").any()
        assert not reader.read().fresh("pressure", max_age_s=10).any()


def test_a_frame_judges_by_the_rate_of_its_driver_or_as_it_is_told() -> None:
    with DriverWriter("a", fake_structure(1, 2), rate_hz=10) as writer, DriverReader("a") as reader:
        publish(writer)
        frame = reader.read()
        assert frame.period_ns == 100 * MS
        taken_ns = frame.acquired_ns
        assert frame.fresh("pressure", at_ns=taken_ns + 300 * MS).tolist() == [True] * 20
        assert not frame.fresh("pressure", at_ns=taken_ns + 301 * MS).any()
        assert frame.fresh("pressure", at_ns=taken_ns + NS_PER_S, max_age_s=1.0).all()
        assert frame.time_ns("temperature").tolist() == [taken_ns] * 4
        publish(writer, status=int(Status.OUT_OF_RANGE))
        assert not reader.read().fresh("pressure", max_age_s=3600).any()
        publish(writer)
        writer.close()
        last = reader.read()
        assert last.stale
        assert not last.fresh("pressure", max_age_s=3600).any()


@pytest.mark.thorough
def test_a_stopped_driver_does_not_look_fresh() -> None:
    """SIGSTOP leaves the lock held and every status 0: only the age tells."""
    with fake_process("fake") as process, Skin() as skin, DriverReader("fake") as reader:
        wait_until(lambda: bool(skin.read().fresh("pressure").all()))
        wait_until(lambda: bool(reader.read().fresh("pressure").all()))
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(2)
        snapshot, frame = skin.read(), reader.read()
        assert snapshot.layout.drivers == ("fake",)
        assert not snapshot.status_of("pressure").any()
        assert not frame.stale
        assert not snapshot.fresh("pressure").any()
        assert not frame.fresh("pressure").any()
        with pytest.raises(ServiceTimeout, match=r"data is too old: fake \(\d"):
            skin.read(max_age_s=0.5, timeout_s=0.1)
        with pytest.raises(
            ServiceTimeout, match=r"no sample younger than 0\.5 s of 'fake': its writer is running, but is"
        ):
            reader.read(max_age_s=0.5, timeout_s=0.1)
        os.kill(process.pid, signal.SIGCONT)
        assert skin.read(max_age_s=0.5, timeout_s=30).fresh("pressure", max_age_s=30).all()
        assert reader.read(max_age_s=0.5, timeout_s=30).fresh("pressure", max_age_s=30).all()


def test_loops_wait_for_what_is_young_enough() -> None:
    with DriverWriter("a", fake_structure(1, 2)) as writer, DriverReader("a") as reader, Skin() as skin:
        for samples in (
            reader.samples(max_age_s=0.5, timeout_s=0.05),
            reader.samples(50, max_age_s=0.5, timeout_s=0.05),
        ):
            publish(writer, age_ns=NS_PER_S)
            with pytest.raises(ServiceTimeout, match="no sample younger"):
                next(samples)
        for snapshots in (skin.samples(max_age_s=0.5, timeout_s=0.05), skin.samples(50, max_age_s=0.5, timeout_s=0.05)):
            publish(writer, age_ns=NS_PER_S)
            with pytest.raises(ServiceTimeout, match="too old: a"):
                next(snapshots)
        publish(writer)
        assert next(reader.samples(max_age_s=30)).sequence == 5
        assert next(skin.samples(max_age_s=30)).samples[0].sequence == 5


def test_one_late_driver_is_named_and_can_be_left_out() -> None:
    structure = fake_structure(1, 2)
    with DriverWriter("hung", structure) as hung, DriverWriter("arm", structure) as arm, Skin() as skin:
        publish(hung, age_ns=90 * NS_PER_S)
        publish(arm)
        wait_until(lambda: len(skin.refresh().drivers) == 2)
        assert skin.read().fresh("pressure", max_age_s=60).tolist() == [True] * 20 + [False] * 20
        with pytest.raises(ServiceTimeout, match=r"too old: hung \([\d.]+ s\) \(choose others"):
            skin.read(max_age_s=60, timeout_s=0)
        with Skin(drivers=["arm"]) as chosen:
            assert chosen.read(max_age_s=60, timeout_s=10).layout.drivers == ("arm",)
