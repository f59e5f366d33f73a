"""The data path in C does what numpy does, whatever a layout says and whatever comes over the wire."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, event, given, settings
from hypothesis import strategies as st

from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Bits, Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.virtual.hand_clock import HandClock
from tests.native.fuzzing import designs
from tests.native.skins import BusDesign, SkinDesign, cycled_skins, plain_skins, skins, skins_of_frames
from tests.native.traffic import Burst, Digest, Event, Pass, Player, Sender, scripts, senders
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.one_path import Marking, MarkingAll, Publishing

pytestmark = [pytest.mark.timeout(600)]  # a failure takes long to shrink
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
        phases=[phase for phase in settings().phases if phase not in (Phase.target, Phase.explain)],
        report_multiple_bugs=False,
        deadline=None,
    )


@pytest.fixture(scope="module")
def clock() -> Iterator[HandClock]:
    with hand_clock() as clock:
        yield clock


@contextmanager
def playing(
    clock: HandClock, design: SkinDesign, publishing: Publishing, watch: type[Marking] = Marking
) -> Iterator[Player]:
    """Both paths for such a skin, and the player that feeds them."""
    with Pair(clock, design.layouts, design.tables(), design.periods_s, publishing, watch=watch) as pair:
        yield Player(design, pair)
        event(f"{min(pair.frames, 10)} frames or more")


@pytest.mark.thorough
@examples(150)
@given(design=skins(), publishing=publishings, script=scripts, watch=st.sampled_from([Marking, MarkingAll]))
def test_whatever_comes(
    clock: HandClock, design: SkinDesign, publishing: Publishing, script: Sequence[Event], watch: type[Marking]
) -> None:
    with playing(clock, design, publishing, watch) as player:
        player.play(script)


@pytest.mark.thorough
@examples(100)
@given(
    design=plain_skins(),
    publishing=publishings,
    senders=senders,
    cuts=st.lists(st.sampled_from([7, 1, 2, 3, 12, 30, 100]), min_size=1, max_size=6),
    is_watched=st.booleans(),
)
def test_bursts(
    clock: HandClock,
    design: SkinDesign,
    publishing: Publishing,
    senders: Sequence[Sender],
    cuts: Sequence[int],
    is_watched: bool,
) -> None:
    with playing(clock, design, replace(publishing, period_s=design.periods_s[0])) as player:
        player.play_senders(senders, cuts, is_watched)


@pytest.mark.thorough
@examples(100)
@given(
    design=cycled_skins(),
    publishing=publishings,
    senders=senders,
    cuts=st.lists(st.sampled_from([7, 1, 2, 3, 12, 30, 100]), min_size=1, max_size=6),
)
def test_cycles(
    clock: HandClock, design: SkinDesign, publishing: Publishing, senders: Sequence[Sender], cuts: Sequence[int]
) -> None:
    with playing(clock, design, replace(publishing, period_s=design.periods_s[0])) as player:
        player.play_senders(senders, cuts, is_watched=True)


@pytest.mark.thorough
@examples(100)
@given(design=skins_of_frames())
def test_values_and_flags(clock: HandClock, design: SkinDesign) -> None:
    with playing(clock, design, Publishing()) as player:
        player.play([event for value in range(24) for event in (Burst(value=value), Digest(), Pass())])


def test_patches_that_send_together_are_shown_together(clock: HandClock) -> None:
    layout = Layout([Frame("data", [Identifier(0x100, 0x7FC)], [1], Values(0, "u1", 1), patch=Bits(shift=0, width=2))])
    patches = [Patch(str(key), [Module(taxels(1, first_uid=key))], key=key) for key in range(3)]
    design = SkinDesign([BusDesign(layout, patches, 0.02)], "u1")
    with Pair(clock, design.layouts, design.tables(), design.periods_s) as pair:
        for period in range(8):
            for key, pause_ms in ((2, 17), (0, 1), (1, 2)):
                pair.feed([(0, clock.now_ns, 0x100 | key, bytes([period]))])
                clock.now_ns += pause_ms * 1_000_000
        assert pair.frames == 8
        assert np.asarray(pair.numpy.frame(8)["values"]).tolist() == [6, 6, 7]  # all of the last 3 ms


def test_signaling_nans_stay_what_they_are(clock: HandClock) -> None:
    raw = bytes.fromhex("7FA00001")
    values = [Values(0, ">f4", 1), Values(4, "<f4", 1, to=[1])]
    layout = Layout([Frame("data", [Identifier(0x100)], [8], values)])
    design = SkinDesign([BusDesign(layout, [Patch("p", [Module(taxels(2))])], 0.02)], "<f4")
    with Pair(clock, design.layouts, design.tables(), design.periods_s) as pair:
        pair.feed([(0, clock.now_ns, 0x100, raw + raw[::-1])])
        assert pair.native.decoder.state.values.tobytes() == 2 * raw[::-1]


def test_a_patch_in_a_hurry_is_told_of_by_both(clock: HandClock) -> None:
    design = designs()["timed cycle"]
    identifiers = [0x100, 0x200, 0x300]
    with Pair(clock, design.layouts, design.tables(), design.periods_s) as pair:
        for _ in range(20):
            frames = []
            for _ in range(6):
                clock.now_ns += 1_000_000
                frames += [(0, clock.now_ns, identifier, bytes(8)) for identifier in identifiers]
            pair.feed(frames)
        assert (pair.native.decoder.haste < -1000).any()
