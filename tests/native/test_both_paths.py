"""The data path in C does what numpy does, whatever a layout says and whatever comes over the wire."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

import pytest
from hypothesis import HealthCheck, Phase, event, given, settings
from hypothesis import strategies as st

from skinware_drivers.testing.clock import HandClock
from tests.native.pair import Pair, Publishing, hand_clock, needs_native
from tests.native.skins import SkinDesign, skins
from tests.native.traffic import Event, Player, scripts

pytestmark = [needs_native, pytest.mark.timeout(600)]  # a failure takes long to shrink
EXAMPLES = int(os.environ.get("SKINWARE_EXAMPLES", "0"))
"""Of each test here; 0: few, and the same each time."""

publishings = st.builds(
    Publishing,
    period_s=st.sampled_from([0.02, 0.005, 0.1]),
    by_cycle=st.sampled_from([True, True, True, False]),
    on_request=st.sampled_from([False, False, False, True]),
    slots=st.sampled_from([8, 2, 3, 64]),
    has_desk=st.booleans(),
)


def examples(few: int) -> settings:
    return settings(
        max_examples=EXAMPLES or few,
        derandomize=not EXAMPLES,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink],
        report_multiple_bugs=False,
        deadline=None,
    )


@pytest.fixture(scope="module")
def clock() -> Iterator[HandClock]:
    with hand_clock() as clock:
        yield clock


@examples(150)
@given(design=skins(), publishing=publishings, script=scripts)
def test_whatever_comes(clock: HandClock, design: SkinDesign, publishing: Publishing, script: Sequence[Event]) -> None:
    with Pair(clock, design.layouts, design.tables(), design.periods_s, publishing) as pair:
        event(pair.why_not or "both")
        if pair.why_not:
            return
        Player(design, pair).play(script)
        event(f"{min(pair.frames, 10)} frames or more")
