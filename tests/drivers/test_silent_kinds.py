"""The table of docs/drivers.md: each driver, one kind of frame silent while the others go on. Each row is run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from skinware.status import PatchState, Status
from skinware_drivers.loading import registered
from skinware_drivers.registry import DRIVERS
from skinware_drivers.testing.rig import play
from skinware_drivers.testing.suite import Suite
from skinware_drivers.virtual.hand_clock import HandClock
from tests.drivers import test_conformance

_PAGE = Path(__file__).parents[2] / "docs/drivers.md"
_ROW = re.compile(r"\| `(\w+)` \| (.+?) \(`([^`]+)`\) \| (\d+) of (\d+) \| (\w+)(?:, others live)? \| (.+?) \|")
_NOT_FRESH = np.uint8(Status.STALE | Status.NEVER_SEEN)
_LEAST_S, _PERIODS = 2.0, 20


class Row(NamedTuple):
    """One row of the table, as a reader of the page sees it."""

    driver: str
    words: str
    kind: str
    stale: int
    sensors: int
    patch: str
    counted: str


def _rows() -> list[Row]:
    section = _PAGE.read_text().split("## One kind of frame is silent")[1].split("\n## ")[0]
    found = [_ROW.fullmatch(line) for line in section.splitlines() if line.startswith("| `")]
    assert all(found), "a row that this test cannot read"
    return [
        Row(match[1], match[2], match[3], int(match[4]), int(match[5]), match[6], match[7])
        for match in found
        if match is not None
    ]


def _suite(driver: str) -> Suite:
    """The driver's first case of the conformance tests."""
    adapter = next(entry for name, entry in registered(DRIVERS).items() if name == driver).load()
    cases = [case for case in vars(test_conformance).values() if isinstance(case, type) and issubclass(case, Suite)]
    return next(case() for case in cases if getattr(case, "driver", None) is adapter)


def test_the_table_names_every_driver() -> None:
    assert sorted({row.driver for row in _rows()}) == sorted(registered(DRIVERS))


@pytest.mark.thorough
@pytest.mark.parametrize("row", _rows(), ids=lambda row: f"{row.driver}-{row.kind}")
def test_the_row_is_what_is_shown(row: Row) -> None:
    suite = _suite(row.driver)

    async def scenario(clock: HandClock) -> tuple[Any, dict[str, int]]:
        async with suite.running(clock) as rig:
            await rig.until_fresh()
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
