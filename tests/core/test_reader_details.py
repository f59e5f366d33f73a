"""The parts of a reader on which no loss shows: figures, the time that is left, lateness, and turns that C takes."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from skinware import DriverReader, DriverWriter, Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import Closed, Overrun, PeerGone, RequestRefused, ServiceNotFound, ServiceTimeout
from skinware.memory import ring as ring_module
from skinware.memory.announcement import living_readers
from skinware.memory.futex import Word
from skinware.memory.ring import slot_headers_of
from skinware.memory.ring_reader import NEXT, Turn, Turns
from skinware.memory.statistics import BUCKETS, Spread, bucket_of
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import _attachment, _taking
from skinware.service import _reader as reader_module
from skinware.service._reader import Tap, samples_after
from skinware.service._taking import Accounts
from tests.cli.fake_skin import fake_structure
from tests.core.services import SMALL, at_0, kill, publish

MS = 1_000_000


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
        for _ in range(2):
            assert reader.read().sequence == 5
        assert (reader.missed, reader.statistics.frames, reader.statistics.age.total) == (1, 5, 5)
        publish(writer, 6)
        assert next(samples).sequence == 6
        assert (reader.missed, reader.statistics.frames) == (1, 6)


@pytest.mark.parametrize("in_place", [False, True])
def test_samples_after_a_position_are_those_that_the_ring_has(in_place: bool) -> None:
    with ServiceWriter("x", SMALL, slots=8) as writer, ServiceReader[Sample]("x") as reader:
        taken: list[Sample] = []
        for last, known, expected in [(0, 0, []), (5, 2, [3, 4, 5]), (5, 9, []), (20, 2, [*range(14, 21)])]:
            for value in range(writer.sequence + 1, last + 1):
                publish(writer, value)
            taken = list(samples_after(reader, (reader.generation, known), in_place=in_place))
            assert [int(sample.column("values")[0]) for sample in taken] == expected
            newest = samples_after(reader, None, in_place=in_place)
            assert [sample.sequence for sample in newest] == [last] * (last > 0)
        publish(writer, 21)
        publish(writer, 22)
        assert [sample.valid for sample in taken] == [not in_place] + [True] * 6


def test_a_tap_says_that_it_reads_in_order_and_reports_what_c_took() -> None:
    with ServiceWriter("x", SMALL, slots=8) as writer, Tap[Sample]("x") as tap:
        tap._accounts.due_ns = now_ns() + 3600 * NS_PER_S
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
        tap.report()  # it is not due
        assert list(living_readers(tap.namespace)) == []
        tap._accounts.due_ns = now_ns()
        tap.report()
        assert [record.frames for record in living_readers(tap.namespace)] == [2]
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


# -- figures -------------------------------------------------------------------------------------------------------


def test_turns_are_added_up_to_the_nanosecond(namespace: Namespace) -> None:
    accounts = Accounts(namespace, "x", announce=False)
    accounts.begin_loop("asap")
    over = [Turn(0, 1_234_567, 1_234_570, 1), Turn(5, 30, 70, 8), Turn(0, 2_000_400, 2_000_500, 3)]
    accounts.settle(Turns(3, 2, 9, over))
    accounts.taken(0)
    accounts.taken(4)
    record = accounts.record
    assert (record.frames, record.missed, record.kind) == (5, 6, "asap")
    assert record.age_ms == 2.0
    assert record.wall == Spread(3, 3, 100, 143)
    assert record.cpu == Spread(1, 7, 7, 7)  # the last one is of another thread
    ages = [0] * BUCKETS
    for age_ns in (1_234_567, 25, 2_000_400):
        ages[bucket_of(age_ns)] += 1
    assert record.age.counts == ages
    accounts.settle(Turns(1, 0, 10, [Turn(0, 1_234_567, 1_234_570, 4)]))
    assert accounts.record.age_ms == 1.235
    assert accounts.record.cpu == Spread(2, 1, 7, 8)
    assert accounts.record.wall.count == 4


def test_a_reader_without_a_loop_has_ages_but_no_turns(namespace: Namespace) -> None:
    accounts = Accounts(namespace, "x", announce=False)
    accounts.settle(Turns(1, 0, 1, [Turn(0, 7, 9, 5)]))
    accounts.end_turn((0, 3))
    record = accounts.record
    assert (record.age.total, record.wall.count, record.cpu.count, record.kind) == (2, 0, 0, "on demand")


def test_the_rate_of_a_reader_is_that_since_it_was_announced(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    namespace.create()
    clock = SimpleNamespace(now_ns=10 * NS_PER_S)
    monkeypatch.setattr(_taking, "now_ns", lambda: clock.now_ns)
    accounts = Accounts(namespace, "x", announce=True)
    rates = []
    for passed_ms, frames in ((0, 5), (250, 10), (249, 3), (1, 1), (500, 0)):
        clock.now_ns += passed_ms * MS
        for _ in range(frames):
            accounts.taken(0)
        accounts.end_turn(None)
        (seen,) = living_readers(namespace)
        rates.append((seen.frames, seen.rate_hz))
    assert rates == [(5, 0.0), (15, 40.0), (15, 40.0), (19, 16.0), (19, 0.0)]
    accounts.close()
    assert list(living_readers(namespace)) == []
    clock.now_ns += NS_PER_S
    accounts.end_turn(None)
    assert list(living_readers(namespace)) == []


def test_a_reader_that_waits_is_still_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now_ns=now_ns())

    def pass_time(_: Word, __: int, timeout_ns: int) -> None:
        clock.now_ns += timeout_ns

    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        monkeypatch.setattr(_taking, "now_ns", lambda: clock.now_ns)
        monkeypatch.setattr(Word, "wait", pass_time)
        clock.now_ns += NS_PER_S
        reader.read()
        publish(writer, 2)
        clock.now_ns += NS_PER_S
        sample = reader.read()
        assert [record.rate_hz for record in living_readers(reader.namespace)] == [1.0]
        begun_ns = clock.now_ns
        with pytest.raises(ServiceTimeout):
            reader.read(newer_than=sample, timeout_s=0.7)
        assert clock.now_ns == begun_ns + 700 * MS
        assert [record.rate_hz for record in living_readers(reader.namespace)] == [0.0]


@pytest.mark.parametrize("is_loop", [False, True])
def test_every_turn_is_counted_also_where_the_next_sample_is_there_already(is_loop: bool) -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        samples = reader.samples(max_age_s=1e6, timeout_s=0)
        for value in range(1, 5):
            publish(writer, value)
            if is_loop:
                assert next(samples).sequence == value
            else:
                assert reader.read(newer_than=(writer.generation, value - 1), max_age_s=1e6).sequence == value
        told = reader.statistics
        assert (told.frames, told.age.total, told.wall.count) == (4, 3, 3 * is_loop)
        reader.read()
        told = reader.statistics
        assert (told.frames, told.age.total, told.wall.count) == (5, 5, 5 * is_loop)


def test_what_c_took_is_counted_when_the_reader_attaches_again() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        samples = reader.in_order(timeout_s=0)
        for value in range(1, 5):
            publish(writer, value)
            next(samples)
        reader.reattach()
        told = reader.statistics
        assert (told.frames, told.age.total, told.wall.count, reader.missed) == (4, 4, 4, 0)
        publish(writer, 5)
        assert next(samples).sequence == 5
        assert reader.statistics.frames == 5


def test_a_view_is_a_turn_that_ends_with_its_block() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for number in (1, 2):
            publish(writer, number)
            with reader.view():
                assert reader.statistics.age.total == number - 1
            assert (reader.statistics.frames, reader.statistics.age.total) == (number, number)


# -- waiting -------------------------------------------------------------------------------------------------------


def refuse_to_wait(*_: object) -> None:
    raise AssertionError("there is no time left to wait")


def test_a_service_that_is_not_there_is_looked_for_ten_times_a_second_until_the_time_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = SimpleNamespace(now_ns=NS_PER_S, waits=0)

    def wait() -> None:
        clock.now_ns += NS_PER_S // clock.rate_hz
        clock.waits += 1

    def periodic(rate_hz: int) -> Any:
        clock.rate_hz = rate_hz
        return SimpleNamespace(wait=wait)

    def look() -> int:
        clock.looks += 1
        assert clock.looks < 20
        return int(clock.now_ns)

    monkeypatch.setattr(_attachment, "now_ns", look)
    monkeypatch.setattr(_attachment, "Periodic", periodic)
    for timeout_s, waits in ((0.0, 0), (0.3, 3), (1.05, 11)):
        clock.waits = clock.looks = 0
        with pytest.raises(ServiceNotFound):
            ServiceReader[Sample]("x", timeout_s=timeout_s)
        assert clock.waits == waits


def test_without_a_limit_a_service_is_looked_for_until_it_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    waits = iter(range(50))
    made: list[ServiceWriter] = []

    def wait() -> None:
        if next(waits) == 49:
            made.append(ServiceWriter("x", SMALL))

    monkeypatch.setattr(_attachment, "Periodic", lambda _: SimpleNamespace(wait=wait))
    with ServiceReader[Sample]("x", timeout_s=None) as reader:
        assert list(waits) == []
        assert reader.newest_position is None
    made.pop().close()


def test_without_time_nothing_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Word, "wait", refuse_to_wait)
    for module in (_taking, reader_module):
        monkeypatch.setattr(module, "now_ns", lambda: NS_PER_S)
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        with pytest.raises(ServiceTimeout):
            reader.read(timeout_s=0)
        publish(writer, 1)
        with pytest.raises(ServiceTimeout):
            reader.read(newer_than=reader.read(timeout_s=0), timeout_s=0)


def test_the_message_of_a_timeout_says_what_the_writer_does() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:

        def read(**how: Any) -> str:
            with pytest.raises(ServiceTimeout) as caught:
                reader.read(timeout_s=0, **how)
            return str(caught.value)

        assert read() == "no sample of 'x' yet: its writer is running, but has published nothing so far"
        publish(writer, 1)
        last = reader.read()
        silent = "of 'x': its writer is running, but is silent (hung, stopped or waiting)"
        assert read(newer_than=last) == f"no newer sample {silent}"
        assert read(max_age_s=-1) == f"no sample younger than -1 s {silent}"
        writer.pause()
        assert reader.paused
        assert read(newer_than=last) == "no newer sample of 'x': its writer is paused"
        writer.resume()
        assert not reader.paused
        kill(writer)
        assert read(newer_than=last) == "no newer sample of 'x': its writer is dead or was stopped; start it again"
    ServiceWriter("x", SMALL).close()  # clears the dead one away


class Deadlines(ServiceReader[Sample]):
    """Returns the deadline of what C leaves to Python."""

    def _read(self, *how: Any) -> Any:
        return how[-1]

    def _read_in_order(self, deadline_ns: int) -> Any:
        return deadline_ns


def test_the_time_that_passed_in_c_counts() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        samples, in_order = reader.samples(timeout_s=7), reader.in_order(timeout_s=8)
        sample = next(samples)
        reader.__class__ = Deadlines
        take: Any = reader._ring.take
        take.next = lambda *_: ()
        take.state_in_c.begun_ns = 5
        deadlines: list[Any] = [reader.read(newer_than=sample, timeout_s=6), next(samples), next(in_order)]
        assert deadlines == [5 + 6 * NS_PER_S, 5 + 7 * NS_PER_S, 5 + 8 * NS_PER_S]


def test_a_stopped_reader_ends_its_loop_at_a_rate() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        count = 0
        for _ in reader.samples(1000):
            count += 1
            if count == 3:
                reader.stop()
        assert count == 3


# -- generations ---------------------------------------------------------------------------------------------------


def test_a_sample_of_a_later_generation_is_found_at_once_though_the_earlier_one_left_no_mark(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    writer = ServiceWriter("x", SMALL)
    with ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        reader.read()
        kill(writer)
        with ServiceWriter("x", SMALL) as later:
            publish(later, 2)
            monkeypatch.setattr(Word, "wait", refuse_to_wait)
            assert reader.read(newer_than=(later.generation, 0), timeout_s=0).position == (later.generation, 1)


def test_a_loop_does_not_change_what_is_newer_than_a_position() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        samples = reader.samples(timeout_s=5)
        for value in (1, 2):
            publish(writer, value)
            assert next(samples).sequence == value
        publish(writer, 3)
        with pytest.raises(ServiceTimeout):
            reader.read(newer_than=(writer.generation, 3), timeout_s=0)
        assert next(samples).sequence == 3
        assert reader.read(newer_than=(writer.generation, 1), timeout_s=0).sequence == 3


def test_a_reader_looks_for_no_other_generation_while_samples_come() -> None:
    with ServiceWriter("x", SMALL) as writer, ReaderInC("x") as reader:
        for value in range(1, 4):
            publish(writer, value)
            assert reader.read(newer_than=(writer.generation, value - 1), max_age_s=1e6).sequence == value
            assert reader.read().sequence == value


def test_a_reader_whose_descriptor_is_0_reads() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        with at_0(reader._ring.segment.descriptor):
            publish(writer, 1)
            assert reader.alive
            assert reader.refresh() == writer.position
            assert reader.read().position == writer.position
            assert reader.read(newer_than=(writer.generation, 0)).position == writer.position
        reader.close()
        with pytest.raises(Closed):
            reader.refresh()


def vanish(writer: ServiceWriter) -> None:
    writer.namespace.ring_path("x").unlink()


def stay(_: ServiceWriter) -> None:
    pass


def be_damaged(writer: ServiceWriter) -> None:
    os.truncate(writer.namespace.ring_path("x"), 100)


@pytest.mark.parametrize("is_restructured", [False, True])
@pytest.mark.parametrize("what", [vanish, stay, be_damaged])
def test_a_dead_writer_is_asked_nothing(is_restructured: bool, what: Callable[[ServiceWriter], None]) -> None:
    writer = ServiceWriter("x", SMALL)
    with ServiceReader[Sample]("x") as reader:
        if is_restructured:
            writer.restructure({"values": ("<u8", 3)})
            reader.refresh()
        assert reader.structure_changed == is_restructured
        with pytest.raises(RequestRefused):  # it lives, and takes no requests
            reader.ask("add", a=1)
        kill(writer)
        if is_restructured or what is stay:
            what(writer)
        with pytest.raises(PeerGone, match="is dead"):
            reader.ask("add", a=1)
    ServiceWriter("x", SMALL).close()  # clears the dead one away


def test_what_a_reader_knows_of_a_service_is_kept_while_its_columns_are_equal() -> None:
    with DriverWriter("a", fake_structure(1, 1)) as writer, DriverReader("a") as reader:
        before = reader.structure
        writer.restructure(fake_structure(1, 1))
        publish(writer, 1)
        assert reader.read().structure is reader.structure is before
        writer.restructure(fake_structure(1, 2))
        reader.reattach()
        assert reader.structure.n_modules == 2


# -- a tap ---------------------------------------------------------------------------------------------------------


def test_a_tap_says_what_the_ring_holds() -> None:
    with ServiceWriter("x", SMALL, slots=8, rate_hz=100) as writer, Tap[Sample]("x") as tap:
        assert (tap.period_ns, tap.slack_ns) == (10 * MS, 80 * MS)
        assert (tap.newest_position, tap.last_taken, tap.moved_on) == (None, None, False)
        for look in (tap.newest_acquired_ns, lambda: tap.nearest(5)):
            with pytest.raises(Overrun, match="no sample could be read"):
                look()
        for acquired_ns in (100, 200, 300):
            writer.begin()
            writer.commit(acquired_ns)
        assert tap.newest_acquired_ns() == tap.newest().acquired_ns == 300
        assert tap.newest_position == tap.last_taken == (writer.generation, 3)
        assert bytes(writer._ring.segment.head) == tap.head
        slot_headers_of(writer._ring.segment)[3][0] = 0  # it is overwritten
        assert tap.newest_acquired_ns() == 200
        writer.close()
        assert tap.moved_on


def test_the_first_nearest_sample_counts_as_taken() -> None:
    with ServiceWriter("x", SMALL) as writer, Tap[Sample]("x") as tap:
        for acquired_ns in (100, 200, 300):
            writer.begin()
            writer.commit(acquired_ns)
        assert tap.nearest(210).acquired_ns == 200
        assert (tap.last_taken, tap.missed) == ((writer.generation, 2), 0)
        assert tap.nearest(1000).acquired_ns == 300
        assert (tap.last_taken, tap.missed, tap.statistics.frames) == ((writer.generation, 3), 0, 2)


def test_the_samples_around_a_time_are_the_last_by_then_and_the_next() -> None:
    with ServiceWriter("x", SMALL) as writer, Tap[Sample]("x") as tap:
        for acquired_ns in (100, 200, 300):
            writer.begin()
            writer.commit(acquired_ns)
        for time_ns, expected in ((0, (100, 100)), (100, (100, 200)), (199, (100, 200)), (200, (200, 300))):
            assert tuple(sample.acquired_ns for sample in tap.around(time_ns)) == expected
        for time_ns in (300, 301, 10_000):
            first, second = tap.around(time_ns)
            assert first is second
            assert first.acquired_ns == 300
        assert (tap.last_taken, tap.missed) == ((writer.generation, 3), 0)
