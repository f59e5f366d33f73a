"""The suite finds torn bursts, and none if halves can be distinguished."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import wire_dtype
from skinware_drivers.description import assemble
from skinware_drivers.fields import Identifier, SequenceNumber
from skinware_drivers.layout import Cycle, Layout
from skinware_drivers.options import NoOptions
from skinware_drivers.testing.torn_tests import BURSTS, Bursts, record, try_troubles
from tests.testing.fingertips import Fingertips

PERIOD_NS = 20_000_000
README = Path(__file__).parents[2] / "README.md"
Wire = npt.NDArray[np.void]


def recording_of(adapter: AnyAdapter, wire: Wire, time_ns: npt.NDArray[np.int64]) -> Bursts:
    tables = assemble([("bus", adapter.patches)], adapter.types, adapter.dtype)
    made = record(adapter.layout, tables, adapter.period_s, wire, time_ns)
    assert made is not None
    return made


def fingertips(counter: SequenceNumber | None = None) -> Bursts:
    """Ten bursts of two frames; the number of the burst is in byte 0, beside the bit that distinguishes the halves."""
    adapter = Fingertips(NoOptions())
    bursts = BURSTS + 2
    wire = np.zeros(2 * bursts, wire_dtype(8))
    number = np.arange(len(wire))
    wire["identifier"], wire["length"] = 0x101, 7
    wire["payload"] = np.random.default_rng(0).integers(0, 256, wire["payload"].shape)
    wire["payload"][:, 0] = number % 2 | (number // 2 % 8) << 4
    layout = adapter.layout
    frames = [replace(f, when=[f.when[0], replace(f.when[1], mask=0x0F)]) for f in layout.frames]
    adapter.layout = Layout(frames, replace(layout.cycle or Cycle((), 0), counter=counter))
    return recording_of(adapter, wire, number // 2 * PERIOD_NS + number % 2 * 500_000)


def test_halves_of_different_bursts_are_joined_where_only_order_and_age_are_known_and_the_suite_sees_it() -> None:
    outcome = try_troubles(fingertips(), with_period=False)
    assert outcome.torn > 2
    assert outcome.first is not None
    assert re.search(
        r"frames in a row were lost, from frame \d of a burst on, while", outcome.first.in_words(fingertips())
    )


def test_a_counter_tells_them_apart_without_any_help() -> None:
    outcome = try_troubles(fingertips(SequenceNumber(0, "u1", mask=0x70)), with_period=False)
    assert outcome.torn == 0
    assert outcome.shown > 4 * outcome.tried


def test_times_tell_them_apart_where_there_is_no_counter() -> None:
    outcome = try_troubles(fingertips())
    assert outcome.torn == 0
    assert outcome.shown > 3 * outcome.tried


@pytest.mark.parametrize("with_period", [True, False])
def test_the_fingertip_of_the_readme_is_never_torn(with_period: bool) -> None:
    (example,) = re.findall(r"```python\n(import numpy.*?class Fingertip.*?)```", README.read_text(), re.DOTALL)
    scope: dict[str, type[AnyAdapter]] = {}
    exec(example, scope)
    adapter = scope["Fingertip"](NoOptions())
    adapter.check()
    bursts, n = BURSTS + 2, len(adapter.layout.frames)
    number = np.arange(n * bursts)
    wire = np.zeros(len(number), wire_dtype(8))
    wire["payload"] = np.random.default_rng(0).integers(0, 256, wire["payload"].shape)
    identifiers = [c.value for frame in adapter.layout.frames for c in frame.when if isinstance(c, Identifier)]
    wire["identifier"] = np.array(identifiers)[number % n]
    wire["length"] = adapter.layout.frames[0].length[0]
    wire["payload"][:, 0] = number // n
    time_ns = number // n * PERIOD_NS + number % n * 200_000
    outcome = try_troubles(recording_of(adapter, wire, time_ns), with_period=with_period)
    assert outcome.torn == 0
    assert outcome.shown > 3 * outcome.tried
