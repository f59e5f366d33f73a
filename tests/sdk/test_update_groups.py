"""Sensors of one module that come in frames of their own: each has the time, age and period of what carries it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Protocol

import numpy as np
import numpy.typing as npt
import pytest

from skinware import PatchState, Status
from skinware.errors import ConfigurationError, StructureError
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware_drivers.description import Module, Patch, Sensor, SkinTables, assemble, taxels
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Cycle, Expand, Frame, Layout, Values
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.one_path import Publishing

MS = 1_000_000
TAXELS, THERMOMETER, MORE = 0x123, 0x124, 0x125
FRAMES = [
    Frame("taxels", [Identifier(TAXELS)], [8], Values(0, "<i2", 4)),
    Frame("temperature", [Identifier(THERMOMETER)], [2], Values(0, "<i2", 1, to=[4])),
]
THERMAL = Sensor("temperature", uid=0)


def skin(*modules: Module) -> SkinTables:
    return assemble([("bus", [Patch("finger", modules)])], [PRESSURE, TEMPERATURE], np.int16)


class Play:
    """A device on both data paths: what it sends, and what is shown of it."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self.frames: list[tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_], list[int]]] = []

    def run(self, duration_ms: int, senders: Sequence[tuple[int, int, int]]) -> None:
        """Let (identifier, length, period in ms) send for so long, the first at once."""
        begin_ns = self.pair.clock.now_ns
        moments = sorted((ms, who) for who in senders for ms in range(0, duration_ms, who[2]))
        for ms, (identifier, length, _) in moments:
            self.pair.pass_to(begin_ns + ms * MS)
            self.pair.feed([(0, self.pair.clock.now_ns, identifier, bytes([1, 0] * (length // 2)))])
            self.look()
        self.pair.pass_to(begin_ns + duration_ms * MS)
        self.look()

    def look(self) -> None:
        way = self.pair.numpy
        if not way.publisher.writer.sequence:
            return
        frame = way.reader.read()
        now_ns, structure = self.pair.clock.now_ns, frame.structure
        limits_ns = structure.age_limits_ns(way.publisher.pace.period_ns)
        fresh = (frame.status == 0) & (frame.sensor_time_ns > 0) & (frame.sensor_time_ns >= now_ns - limits_ns)
        self.frames.append((frame.status, fresh, frame.patch_state.tolist()))

    @property
    def status(self) -> list[int]:
        return [int(bits) for bits in self.frames[-1][0]]


class Played(Protocol):
    def __call__(
        self, layout: Layout, tables: SkinTables, period_s: float = 0.01, *, by_cycle: bool = True
    ) -> Play: ...


@pytest.fixture
def played() -> Iterator[Played]:
    with hand_clock() as clock, ExitStack() as stack:

        def make(layout: Layout, tables: SkinTables, period_s: float = 0.01, *, by_cycle: bool = True) -> Play:
            pair = Pair(clock, [layout], tables, [period_s], Publishing(period_s, by_cycle))
            return Play(stack.enter_context(pair))

        yield make


@pytest.mark.parametrize("by_cycle", [True, False])
@pytest.mark.parametrize("at", [0, 4])
def test_a_silent_kind_of_frame_makes_exactly_its_sensors_stale(played: Played, at: int, by_cycle: bool) -> None:
    pressures = [channel for channel in range(5) if channel != at]
    frames = [
        Frame("taxels", [Identifier(TAXELS)], [8], Values(0, "<i2", 4, to=pressures)),
        Frame("temperature", [Identifier(THERMOMETER)], [2], Values(0, "<i2", 1, to=[at])),
    ]
    sensors = taxels(4)
    play = played(Layout(frames), skin(Module([*sensors[:at], THERMAL, *sensors[at:]])), 0.02, by_cycle=by_cycle)
    for senders, taxels_are, temperature_is in (
        ([(TAXELS, 8, 20)], 0, Status.NEVER_SEEN),
        ([(TAXELS, 8, 20), (THERMOMETER, 2, 20)], 0, 0),
        ([(TAXELS, 8, 20)], 0, Status.STALE),
        ([(THERMOMETER, 2, 20)], Status.STALE, 0),
    ):
        play.run(1000, senders)
        assert play.status == [temperature_is if channel == at else taxels_are for channel in range(5)]


SLOW = [FRAMES[0], Frame("temperature", [Identifier(THERMOMETER)], [2], Values(0, "<i2", 1, to=[4]), period_s=1.0)]
KEYED = [
    Frame("taxels", [Identifier(TAXELS)], [8], Values(0, "<i2", 4), module=0),
    Frame("temperature", [Identifier(THERMOMETER)], [2], Values(0, "<i2", 1), module=1),
]
APART = [
    Frame("taxels", [Identifier(TAXELS)], [8], Values(0, "<i2", 4), patch=0),
    Frame("temperature", [Identifier(THERMOMETER)], [2], Values(0, "<i2", 1), patch=1),
]
SLOW_MODULE = Module([THERMAL], key=1, period_s=1.0)
THERMOMETERS = {
    "in its module": (SLOW, [Patch("finger", [Module([*taxels(4), THERMAL])])]),
    "a module": (KEYED, [Patch("finger", [Module(taxels(4)), SLOW_MODULE])]),
    "a patch": (
        APART,
        [Patch("finger", [Module(taxels(4))]), Patch("thermometer", [Module([THERMAL], period_s=1.0)], key=1)],
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("by_cycle", [True, False])
@pytest.mark.parametrize("where", THERMOMETERS)
def test_a_slow_thermometer_is_fresh_until_three_of_its_own_periods(played: Played, where: str, by_cycle: bool) -> None:
    frames, patches = THERMOMETERS[where]
    tables = assemble([("bus", patches)], [PRESSURE, TEMPERATURE], np.int16)
    play = played(Layout(frames), tables, by_cycle=by_cycle)
    play.run(1000, [(THERMOMETER, 2, 1000), (TAXELS, 8, 10)])
    play.frames.clear()
    play.run(6000, [(THERMOMETER, 2, 1000), (TAXELS, 8, 10)])
    assert all(fresh.all() for _, fresh, _ in play.frames)
    assert all(set(states) == {PatchState.LIVE} for _, _, states in play.frames)
    assert play.pair.frames >= 650  # frames wait for no thermometer
    play.run(2000, [(TAXELS, 8, 10)])  # the last one is three seconds old by now
    assert play.frames[-3][0].tolist() == [0] * 5
    play.run(500, [(TAXELS, 8, 10)])
    assert play.status == [0, 0, 0, 0, Status.STALE]


def test_a_thermometer_alone_keeps_its_patch_live_but_no_taxel_fresh(played: Played) -> None:
    play = played(Layout(SLOW), skin(Module([*taxels(4), THERMAL])))
    play.run(1000, [(TAXELS, 8, 10), (THERMOMETER, 2, 1000)])
    play.run(4000, [(THERMOMETER, 2, 1000)])
    assert play.status == [Status.STALE] * 4 + [0]
    assert play.frames[-1][2] == [PatchState.LIVE]
    play.run(3500, [])
    assert play.frames[-1][2] == [PatchState.STALE]
    assert play.status == [Status.STALE] * 5


def test_a_sensor_of_two_kinds_of_frame_is_fresh_with_either(played: Played) -> None:
    """A long frame now and then, a short one beside it: the rest of the long one has the long one's age."""
    frames = [
        Frame("long", [Identifier(TAXELS)], [8], Values(0, "<i2", 4)),
        Frame("short", [Identifier(MORE)], [4], Values(0, "<i2", 2)),
    ]
    play = played(Layout(frames), skin(Module(taxels(4))))
    play.run(500, [(TAXELS, 8, 10), (MORE, 4, 10)])
    assert play.status == [0] * 4
    play.run(500, [(MORE, 4, 10)])
    assert play.status == [0, 0, Status.STALE, Status.STALE]
    play.run(500, [(TAXELS, 8, 10)])
    assert play.status == [0] * 4
    assert play.pair.numpy.decoder.tables.structure.n_groups == 2


def four_bytes(
    payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int16]]:
    del length
    row, channel = np.divmod(np.arange(4 * len(payload)), 4)
    return row, channel, payload[:, :4].reshape(-1).astype(np.int16)


def test_an_expand_says_which_channels_it_keeps_fresh(played: Played) -> None:
    frames = [Frame("taxels", [Identifier(TAXELS)], [8], Expand(four_bytes, to=range(4))), FRAMES[1]]
    play = played(Layout(frames), skin(Module([*taxels(4), THERMAL])))
    play.run(500, [(TAXELS, 8, 10), (THERMOMETER, 2, 10)])
    play.run(500, [(TAXELS, 8, 10)])
    assert play.status == [0, 0, 0, 0, Status.STALE]


def test_a_cycle_is_one_group_and_needs_no_tables(played: Played) -> None:
    halves = [
        Frame("one", [Identifier(TAXELS)], [4], Values(0, "<i2", 2)),
        Frame("two", [Identifier(MORE)], [4], Values(0, "<i2", 2, to=[2, 3])),
    ]
    tables = skin(Module(taxels(4)))
    play = played(Layout(halves, Cycle(["one", "two"], 0.004)), tables)
    structure = play.pair.numpy.decoder.tables.structure
    assert structure.groups_are_modules
    assert structure == tables.structure
    assert "group_time_ns" not in play.pair.numpy.writer.column_offsets()
    assert not {"sensor_group", "group_module", "group_period_ns"} & structure.to_columns().keys()


def test_a_module_is_as_old_as_its_oldest_group(played: Played) -> None:
    play = played(Layout(FRAMES), skin(Module([*taxels(4), THERMAL])))
    play.run(20, [(TAXELS, 8, 10)])
    assert play.pair.numpy.reader.read().module_time_ns.tolist() == [0]
    play.run(300, [(TAXELS, 8, 10), (THERMOMETER, 2, 100)])
    frame = play.pair.numpy.reader.read()
    assert frame.group_time_ns[0] > frame.group_time_ns[1] == frame.module_time_ns[0]


@pytest.mark.parametrize("period_s", [0, -1.0, float("nan"), 1e6])
def test_impossible_periods_are_refused(period_s: float) -> None:
    with pytest.raises(ConfigurationError, match="period_s"):
        Layout([Frame("taxels", [], [8], Values(0, "<i2", 4), period_s=period_s)])
    with pytest.raises(StructureError, match="period_s"):
        skin(Module(taxels(4), period_s=period_s))
