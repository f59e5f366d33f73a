"""That C does with the frames of a device what numpy does, bit by bit."""

from __future__ import annotations

from typing import Literal

import pytest

from skinware_drivers.testing.both_paths import Pair, hand_clock, why_python
from skinware_drivers.testing.both_streams import both_streams
from skinware_drivers.testing.defect import require
from skinware_drivers.testing.one_path import Publishing
from skinware_drivers.testing.rig import Running, play
from skinware_drivers.testing.stumbling import Stumbling
from skinware_drivers.testing.suite import Suite
from skinware_drivers.testing.torn_tests import Heard
from skinware_drivers.virtual.hand_clock import HandClock

Trouble = Literal["nothing", "lost", "truncated", "repeated", "garbage", "stumbling", "restart"]
_PERIODS = 40
_BETWEEN_DAMAGES = 4
_FRAMES_OF_A_BURST = 4


class PathTests(Suite):
    """The two data paths side by side."""

    @pytest.mark.parametrize("trouble", ["nothing", "lost", "truncated", "repeated", "garbage", "stumbling", "restart"])
    def test_both_data_paths_do_the_same(self, trouble: Trouble) -> None:
        """What the devices send, with something wrong: numpy and C publish, count and remember the same.

        If they do not, that is a fault of Skinware's.
        """
        if why_python():
            pytest.skip(f"no data path in C: {why_python()}")
        with both_streams():
            heard, rig = self._hear(trouble)
        require(heard.takes, "the devices sent nothing")
        adapter = rig.adapter
        with (
            hand_clock(heard.takes[0].now_ns) as clock,
            Pair(
                clock,
                [adapter.layout],
                heard.tables,
                [adapter.period_s],
                Publishing(adapter.period_s, adapter.by_cycle),
                rows=max(len(take.wire) for take in heard.takes),
                watch=adapter.watch,
                payload_size=adapter.payload_size,
            ) as pair,
        ):
            require(not pair.why_not, f"C cannot do what this layout says: {pair.why_not}")
            for take in heard.takes:
                pair.pass_to(take.now_ns)
                pair.feed_rows(take.wire, take.time_ns)
            pair.pass_to(clock.now_ns + 4 * rig.period_ns)
            require(pair.frames, "nothing was published")

    def _hear(self, trouble: Trouble) -> tuple[Heard, Running]:
        """What a running driver receives while something is wrong."""

        async def scenario(clock: HandClock) -> tuple[Heard, Running]:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                heard = Heard(rig)
                if trouble == "stumbling":
                    rig.wire.stumbling = Stumbling(rig.period_ns, _FRAMES_OF_A_BURST)
                elif trouble == "restart":
                    await rig.sleep(4 * rig.adapter.period_s)
                    rig.devices.restart(rig.numbers[0], clock.now_ns)
                elif trouble != "nothing":
                    rig.wire.fault, rig.wire.every_ns = trouble, _BETWEEN_DAMAGES * rig.period_ns
                await rig.sleep(_PERIODS * rig.adapter.period_s)
                return heard, rig

        return play(scenario)
