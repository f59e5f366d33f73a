"""Each driver, one kind of frame silent while the others go on: exactly its sensors become stale."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from skinware.status import PatchState, Status
from skinware_drivers.loading import registered
from skinware_drivers.registry import DRIVERS
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.rig import Suite, play
from skinware_drivers.virtual.hand_clock import HandClock
from tests.drivers import test_conformance

_NOT_FRESH = np.uint8(Status.STALE | Status.NEVER_SEEN)
_LEAST_S, _PERIODS = 2.0, 20


class Row(NamedTuple):
    """Effects of a silent kind: what becomes stale, the state of the patch, and the counter that shows it."""

    driver: str
    kind: str
    stale: int
    sensors: int
    patch: str
    counted: str


ROWS = (
    Row("ability_hand", "data", 30, 30, "stale", ""),  # the answer with the touch
    Row("agni", "sensor1", 16, 20, "live", ""),  # the message of a sensor
    Row("allegro_v5", "0x150", 8, 16, "live", ""),  # one of two frames of pads
    Row("anyskin", "data", 20, 20, "stale", ""),  # the message
    Row("barrett", "0x569-1", 24, 96, "restarted", "orphans"),  # one of five frames of a puck
    Row("canopen", "0x185", 4, 32, "live", ""),  # one TPDO of a node
    Row("cyskin_cpm", "0x407", 16, 16, "stale", "orphans"),  # one of four frames of a set
    Row("dev001", "port2", 4, 20, "live", ""),  # the records of a sensor
    Row("dex3", "hand0", 216, 432, "stale", ""),  # the samples of a hand
    Row("dfrobot", "20", 72, 72, "stale", "polls_unanswered"),  # a register of the cells, in both arrays
    Row("flexitac", "data", 384, 384, "stale", ""),  # the frame
    Row("icub_eth", "0x410-tail", 12, 144, "live", "orphans"),  # one half of a triangle
    Row(
        "inspire", "3000", 185, 1062, "live", "polls_unanswered"
    ),  # a register of a fingertip, with all that its question reads
    Row("inspire", "5122", 112, 1062, "live", "polls_unanswered"),  # a register of the palm
    Row("linkerhand", "0xb1", 72, 360, "live", "polls_unanswered"),  # the rows of the thumb
    Row("openpatch", "module1", 12, 48, "live", ""),  # the message of a module
    Row("papillarray", "slip", 6, 162, "live", ""),  # a block of the packet
    Row("paxini", "data", 156, 156, "stale", "polls_unanswered"),  # the answers with forces
    Row("revo2", "4200", 20, 20, "stale", "polls_unanswered"),  # a register of the fingertips
    Row("revo3", "4200", 124, 416, "live", "polls_unanswered"),  # a register of a pad, with all that its question reads
    Row("roboskin", "0x470-head", 12, 768, "live", "orphans"),  # the first half of a triangle
    Row("roboskin", "0x470-tail", 12, 768, "live", "orphans"),  # the second half of a triangle
    Row("robotiq_tsf", "temperature0", 1, 78, "live", ""),  # a field of a finger
    Row("robotiq_tsf", "static1", 28, 78, "live", ""),  # the taxels of the other
    Row("ros2", "topic0", 24, 48, "stale", ""),  # the messages of a topic
    Row("skintalk", "0x10", 1, 24, "live", ""),  # the record of a cell
    Row("tactile_glove", "0x3c", 1, 64, "live", ""),  # the packet of a taxel
    Row("tesollo", "data", 75, 75, "restarted", "polls_unanswered"),  # the answers with data
    Row("weiss_dsa", "data", 486, 486, "restarted", ""),  # the frame
    Row("weiss_wts", "data", 32, 32, "restarted", ""),  # the frame
    Row("wuji_glove", "data", 768, 768, "restarted", ""),  # the frame
    Row("xela", "0x710", 3, 48, "live", ""),  # the frame of a taxel
    Row("xela_server", "sensor1", 48, 48, "stale", ""),  # the values of a sensor
    Row("yarp", "data", 41, 41, "stale", ""),  # the vectors
)


def _suite(driver: str) -> Suite:
    """The driver's first case of the conformance tests."""
    adapter = next(entry for name, entry in registered(DRIVERS).items() if name == driver).load()
    cases = [case for case in vars(test_conformance).values() if isinstance(case, type) and issubclass(case, Suite)]
    return next(case() for case in cases if getattr(case, "driver", None) is adapter)


def test_the_table_names_every_driver() -> None:
    assert sorted({row.driver for row in ROWS}) == sorted(registered(DRIVERS))


@pytest.mark.thorough
@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.driver}-{row.kind}")
def test_the_row_is_what_is_shown(row: Row) -> None:
    suite = _suite(row.driver)

    async def scenario(clock: HandClock) -> tuple[Any, dict[str, int]]:
        async with suite.running(clock) as rig:
            await until_fresh(rig)
            before = rig.counters()
            rig.devices.silent.add(row.kind)
            await rig.sleep(max(_LEAST_S, _PERIODS * rig.adapter.period_s))
            assert rig.devices.counts["silenced"] or row.driver == "icub_eth", "nothing was silent"
            counted = {name: count - before[name] for name, count in rig.counters().items()}
            return rig.record.frames[-1], counted

    frame, counted = play(scenario)
    stale = frame.status & _NOT_FRESH != 0
    assert (int(stale.sum()), len(stale)) == (row.stale, row.sensors)
    states = {PatchState(int(state)).name.lower() for state in frame.patch_state}
    of_stale = frame.structure.sensor_patch[np.flatnonzero(stale)]
    silent = {PatchState(int(frame.patch_state[patch])).name.lower() for patch in np.unique(of_stale)}
    assert silent == {row.patch}
    assert states <= {row.patch, "live"}
    for name in ("orphans", "polls_unanswered"):
        assert bool(counted.get(name)) == (name in row.counted), (name, counted)
