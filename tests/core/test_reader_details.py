"""The parts of a reader on which no loss shows: ages, the time that is left, lateness, and turns that C takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from skinware import Sample, ServiceReader, ServiceWriter
from skinware.errors import ServiceTimeout
from skinware.memory import ring as ring_module
from skinware.memory.ring_reader import NEXT
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import _reader as reader_module
from skinware.service._reader import Tap
from tests.core.services import SMALL, publish


def test_a_sample_that_is_young_enough_is_given_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()
        writer.commit(1_000)
        monkeypatch.setattr(ring_module, "now_ns", lambda: 1_000 + 2 * NS_PER_S)
        assert reader.read(max_age_s=3, timeout_s=0).sequence == 1
        assert reader.read(max_age_s=2, timeout_s=0).sequence == 1
        with pytest.raises(ServiceTimeout):
            reader.read(max_age_s=1.9, timeout_s=0)


def test_the_text_of_a_sample_has_its_age(monkeypatch: pytest.MonkeyPatch) -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()
        writer.commit(1_000)
        monkeypatch.setattr(ring_module, "now_ns", lambda: 2_501_000)
        assert repr(reader.read()).endswith(", 2.5 ms old>")


class AskedReader(ServiceReader[Sample]):
    """Has an answer at once, and returns how its sample is read."""

    def ask(self, *_: object, **__: object) -> Any:
        return SimpleNamespace(result=lambda _: SimpleNamespace(generation=7, sequence=4))

    def read(self, **how: object) -> Any:
        return how


def test_a_request_leaves_to_the_read_the_time_that_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    with ServiceWriter("x", SMALL), AskedReader("x") as reader:
        for passed_s, left_s in ((3, 2.0), (9, 0.0)):
            times_ns = iter((100, 100 + passed_s * NS_PER_S))
            with monkeypatch.context() as patched:
                patched.setattr(reader_module, "now_ns", times_ns.__next__)
                asked: Any = reader.request(timeout_s=5)
            assert asked == {"newer_than": (7, 3), "timeout_s": left_s}


def test_the_lateness_of_a_loop_at_a_rate_is_counted_from_its_deadlines(monkeypatch: pytest.MonkeyPatch) -> None:
    timer = SimpleNamespace(wait=lambda _: True, deadline_ns=5_000_000, period_ns=1_000_000, missed=3)
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        with monkeypatch.context() as patched:
            patched.setattr(reader_module, "Periodic", lambda _: timer)
            patched.setattr(reader_module, "now_ns", lambda: 4_000_700)
            assert next(reader.samples(1000)).sequence == 1
        record = reader.statistics
        assert (record.lateness.total, record.missed_periods, record.kind) == (1, 3, "periodic 1000 Hz")
        late = type(record.lateness)()
        late.add(700)
        assert record.lateness.counts == late.counts


class ReaderInC(ServiceReader[Sample]):
    """Fails where Python would take a sample in order, once that is forbidden, or look for a new generation."""

    is_forbidden = False

    def _read_in_order(self, deadline_ns: int) -> Sample:
        assert not self.is_forbidden
        return super()._read_in_order(deadline_ns)

    def _follow(self) -> None:
        raise AssertionError("the writer of the generation at hand lives")


def test_turns_of_a_loop_are_taken_in_c_and_counted() -> None:
    with ServiceWriter("x", SMALL, slots=8) as writer, ReaderInC("x") as reader:
        samples = reader.in_order(timeout_s=5)
        publish(writer, 1)
        assert next(samples).sequence == 1
        reader.is_forbidden = True
        for value in (2, 3):
            publish(writer, value)
            assert next(samples).sequence == value
        reader.is_forbidden = False
        assert reader.statistics.frames == 3
        publish(writer, 4)
        publish(writer, 5)
        assert reader.read().sequence == 5
        assert (reader.missed, reader.statistics.frames) == (1, 4)
        publish(writer, 6)
        assert next(samples).sequence == 6
        assert (reader.missed, reader.statistics.frames) == (1, 5)


def test_a_tap_says_that_it_reads_in_order_and_reports_what_c_took() -> None:
    with ServiceWriter("x", SMALL, slots=8) as writer, Tap[Sample]("x") as tap:
        publish(writer, 1)
        tap.begin_in_order(with_first=True)
        assert tap.statistics.kind == "in order"
        first = tap.next_in_order()
        assert first is not None
        assert first.sequence == 1
        assert tap.next_in_order() is None
        publish(writer, 2)
        ring = tap.ring_in_c()
        assert ring is tap.ring_in_c()
        assert ring.state_in_c.last == 1
        (second,) = ring.take.next(NEXT, 0) or ()
        assert second.sequence == 2
        tap._accounts.due_ns = now_ns()
        tap.report()
        assert tap.last_taken == (second.generation, 2)


def test_the_newest_sample_stays_readable_while_a_whole_ring_is_skipped() -> None:
    for published in (1, 2, 5):
        with ServiceWriter("x", SMALL, slots=4) as writer, ServiceReader[Sample]("x") as reader:
            for value in range(published):
                publish(writer, value)
            ring = writer._ring
            ring.begin(skip=3)
            assert reader.read().sequence == published
            ring.commit(now_ns())
            assert reader.read().sequence == published + 5
