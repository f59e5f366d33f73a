"""That halves of different bursts are never shown as one, whatever is lost, late or caught up."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import FrameBatch
from skinware_drivers.description import SkinTables
from skinware_drivers.testing.comparison import Comparison
from skinware_drivers.testing.defect import defect, require
from skinware_drivers.testing.replaying import BURSTS, Recording, counter_values, record, try_troubles
from skinware_drivers.testing.rig import Running, play
from skinware_drivers.testing.suite import Suite
from skinware_drivers.testing.wire import Stumbling
from skinware_drivers.virtual.hand_clock import HandClock

_STUMBLING_PERIODS = 80
_WHAT_TO_DO = (
    "say in the layout's Cycle where its frames have a `counter`; where they have none, make `maximum_age_s` half a"
    " period or shorter"
)


class TornTests(Suite):
    """Runs of lost frames, and senders that stand still and catch up."""

    def test_no_run_of_lost_frames_tears_a_burst(self) -> None:
        """Every run up to two bursts long, from every frame on; the frames round it in time, late, or caught up."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                if not rig.adapter.layout.cycles:
                    return  # a frame is all of an update
                heard = Heard(rig)
                await rig.sleep((BURSTS + 4) * rig.adapter.period_s)
                recording = heard.recording()
            if recording is None:
                defect(f"the emulated devices send fewer than {BURSTS} bursts in {BURSTS + 4} periods")
            _require_counting(recording)
            outcome = try_troubles(recording)
            require(outcome.shown >= 2 * outcome.tried, "hardly anything is shown when frames are lost now and then")
            if outcome.first is not None:
                defect(
                    f"{outcome.torn} of {outcome.shown} updates show values of two bursts as if they were fresh:"
                    f" {outcome.first.in_words(recording)}; {_WHAT_TO_DO}"
                )

        play(scenario)

    def test_nothing_torn_is_shown_while_a_sender_stumbles(self) -> None:
        """The driver runs while its devices lose runs of frames, stand still and catch up; then all is fresh again."""

        async def scenario(clock: HandClock) -> None:
            async with self.running(clock) as rig:
                await rig.until_fresh()
                before, bursts = rig.wire.frames, _bursts(rig)
                await rig.sleep(8 * rig.adapter.period_s)
                size = round((rig.wire.frames - before) / max(1, _bursts(rig) - bursts))
                rig.wire.stumbling = Stumbling(rig.period_ns, max(1, size))
                await rig.sleep(_STUMBLING_PERIODS * rig.adapter.period_s)
                require(rig.wire.stumbling.stumbles > 3, "the emulated devices send too little to test faults with")
                rig.wire.stumbling = None
                end_ns = clock.now_ns
                await rig.sleep(4 * rig.adapter.period_s)
                Comparison(rig).require_right("runs of frames were lost, and the sender stood still and caught up")
                shown_ns = rig.record.frames[-1].module_time_ns
                require((shown_ns > end_ns).all(), "the sender is in order again, but not all modules are shown anew")

        play(scenario)


def _require_counting(recording: Recording) -> None:
    numbers = counter_values(recording)
    if len(numbers) == 1:
        defect(
            f"the `counter` of the cycle is {numbers[0]} in all frames of {BURSTS} bursts, so that it tells nothing"
            " apart: look at its `offset`, `dtype` and `mask`"
        )


def _bursts(rig: Running) -> int:
    return max(len(bursts) for bursts in rig.truth.bursts.values())


class Take(NamedTuple):
    """Frames that a bus delivered at once.

    Attributes:
        now_ns: when it did.
        wire: (n,) as in a batch.
        time_ns: (n,) int64, stamps.
    """

    now_ns: int
    wire: npt.NDArray[np.void]
    time_ns: npt.NDArray[np.int64]


class Heard:
    """What a driver's bus delivers from now on.

    Args:
        rig: the driver; it runs.

    Attributes:
        takes: in order, those without frames left out.
        tables: the skin.
    """

    def __init__(self, rig: Running) -> None:
        if rig.runner is None or rig.runner.builder.generation is None:
            defect("the driver publishes nothing yet")
        self._rig = rig
        self.takes: list[Take] = []
        self.tables: SkinTables = rig.runner.builder.generation.tables
        receive = rig.bus.receive

        def listen(batch: FrameBatch, ordinal: int) -> int:
            first = batch.stop
            count = receive(batch, ordinal)
            if batch.stop > first:
                rows = slice(first, batch.stop)
                self.takes.append(Take(rig.clock.now_ns, batch.wire[rows].copy(), batch.time_ns[rows].copy()))
            return count

        rig.bus.receive = listen  # type: ignore[method-assign]

    def recording(self, bursts: int = BURSTS) -> Recording | None:
        """So many bursts of the first patch; None if there are not so many."""
        if not self.takes:
            return None
        wire, time_ns = np.concatenate([t.wire for t in self.takes]), np.concatenate([t.time_ns for t in self.takes])
        adapter = self._rig.adapter
        return record(adapter.layout, self.tables, adapter.period_s, wire, time_ns, bursts)
