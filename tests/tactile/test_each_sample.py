"""A service that was held up reads each sample that the ring still has, once and in order."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from skinware import DriverReader, DriverWriter, Namespace, Structure
from skinware.cli._gathering import Gathering
from skinware.sensor_types import PRESSURE
from skinware.tactile.calibration.sources import LoadSource, PoseSource
from skinware.tactile.calibration.state import PressSession
from skinware.tactile.calm_driver import DriverSource
from skinware.tactile.calm_service import CalmService
from skinware.tactile.contacts_service import ContactsReader
from skinware.tactile.onsets import EventKind
from skinware.views.live import frames_until
from skinware_drivers.testing.waiting import wait_until
from tests.commands import running
from tests.tactile.skins import placed, triangles

N, PERIOD_NS = 120, 10_000_000
PRESSED = [65, 66, 77, 78]


def structure() -> Structure:
    made = Structure(
        types=[PRESSURE.measured(unit="counts", maximum=255.0)],
        buses=["can0"],
        patch_name=["palm"],
        patch_bus=[0],
        module_patch=np.zeros(10, int),
        module_kind=["triangle"] * 10,
        sensor_uid=np.arange(N),
        sensor_type=[PRESSURE.id] * N,
        sensor_module=np.arange(N) // 12,
        dtype="u1",
    )
    return made.placed(placed(triangles(10, 12)))


class Hand:
    """A driver whose samples are stamped by their number, 10 ms apart."""

    def __init__(self, slots: int = 64) -> None:
        self._random = np.random.default_rng(1)
        self.writer = DriverWriter("hand", structure(), rate_hz=100, slots=slots)

    def publish(self, count: int, load: float = 0.0) -> None:
        for _ in range(count):
            columns = self.writer.begin()
            for column in columns.values():
                column[:] = 0
            pressed = 15 + 0.8 * self._random.standard_normal(N)
            pressed[PRESSED] += load
            columns["values"][:] = np.round(pressed)
            columns["module_time_ns"][:] = time_ns = (self.writer.sequence + 1) * PERIOD_NS
            self.writer.commit(time_ns)


@contextmanager
def following(hand: Hand) -> Iterator[DriverSource]:
    with closing(DriverSource("hand", Namespace())) as source:
        hand.publish(1)
        assert take(source) == [1]
        yield source


def take(source: DriverSource) -> list[int]:
    if source.reader is None:
        assert source.next_frame() is None
    return [frame.sequence for frame in iter(source.next_frame, None)]


def missed(source: DriverSource) -> int:
    assert source.reader is not None
    return source.reader.missed


def test_samples_of_a_hold_up_are_read_in_order() -> None:
    hand = Hand()
    with hand.writer, following(hand) as source:
        for first, count in (2, 5), (7, 1), (8, 62):
            hand.publish(count)
            assert take(source) == list(range(first, first + count))
        assert missed(source) == 0


def test_what_came_before_the_first_sample_was_not_waiting() -> None:
    hand = Hand()
    with hand.writer, closing(DriverSource("hand", Namespace())) as source:
        hand.publish(5)
        assert source.next_frame() is None
        frame = source.next_frame()
        assert frame is not None
        assert frame.sequence == 5
        hand.publish(40)
        assert take(source) == list(range(6, 46))


def test_what_the_ring_has_no_more_is_missed_and_the_rest_read() -> None:
    hand = Hand(slots=8)
    with hand.writer, following(hand) as source:
        hand.publish(20)
        read = take(source)
        assert read == list(range(22 - len(read), 22))
        assert len(read) == 7
        assert missed(source) == 13
        hand.publish(3)
        assert take(source) == [22, 23, 24]


def test_a_program_that_is_too_slow_is_late_for_4_samples_and_then_has_the_newest() -> None:
    hand = Hand()
    with hand.writer, following(hand) as source:
        read, late = [1], []
        for _ in range(200):
            hand.publish(2)
            frame = source.next_frame()
            assert frame is not None
            read.append(frame.sequence)
            late.append(hand.writer.sequence - frame.sequence)
        assert late[:2] == [1, 2]
        assert late[2:] == [0] * 198
        assert source.reader is not None
        assert source.reader.is_too_slow
        assert len(read) + missed(source) == hand.writer.sequence
        assert take(source) == []
        first = hand.writer.sequence + 1
        hand.publish(5)
        assert take(source) == list(range(first, first + 5))
        assert not source.reader.is_too_slow


def test_a_program_that_needs_a_quarter_of_the_period_gets_all_of_a_full_ring() -> None:
    hand = Hand()
    with hand.writer, following(hand) as source:
        hand.publish(60)
        read = [1]
        while len(read) < hand.writer.sequence:
            hand.publish(len(read) % 4 == 0)
            frame = source.next_frame()
            assert frame is not None
            read.append(frame.sequence)
        assert read == list(range(1, len(read) + 1))
        assert len(read) == 80


def test_a_driver_that_ends_is_read_to_its_end_and_its_successor_from_the_first() -> None:
    hand = Hand()
    with following(hand) as source:
        hand.publish(5)
        hand.writer.close()
        assert take(source) == [2, 3, 4, 5, 6]
        assert not source.alive
        hand = Hand()
        hand.publish(3)
        hand.writer.close()
        hand = Hand()
        with hand.writer:
            hand.publish(4)
            assert take(source) == [1, 2, 3, 4]
            assert missed(source) == 3


class HeldUp:
    """A service in a thread, which publishing holds up, so that all samples of a call wait for it at once."""

    def __init__(self, hand: Hand, service: CalmService) -> None:
        self._hand, self._service = hand, service
        self._is_wanted, self._is_held, self._go_on = threading.Event(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=service.run, args=(self._hold_up, 0.0))

    def _hold_up(self) -> None:
        if self._is_wanted.is_set():
            self._is_held.set()
            self._go_on.wait(60)

    def publish(self, *loads: float) -> None:
        self._is_held.clear()
        self._go_on.clear()
        self._is_wanted.set()
        assert self._is_held.wait(60)
        for load in loads:
            self._hand.publish(1, load)
        self._is_wanted.clear()
        self._go_on.set()
        wait_until(lambda: self._service.frames == self._hand.writer.sequence)

    def __enter__(self) -> HeldUp:
        self._hand.publish(1)
        self._thread.start()
        wait_until(lambda: self._service.frames == 1)
        return self

    def __exit__(self, *_: object) -> None:
        self._service.stop()
        self._thread.join()


def test_an_onset_in_a_hold_up_is_that_of_the_second_touched_sample(calm_namespace: Namespace, tmp_path: Path) -> None:
    hand, service = Hand(), CalmService("hand", into=calm_namespace, state_path=tmp_path / "state.npz")
    with hand.writer, HeldUp(hand, service) as held:
        for _ in range(20):
            held.publish(*[0.0] * 40)
        with ContactsReader(namespace=calm_namespace) as contacts:
            contacts.read()
            before = hand.writer.sequence
            held.publish(*[0.0] * 20, *[8.0] * 20)
            event = next(contacts.events(timeout_s=30))
            assert (event.kind, event.acquired_ns) == (EventKind.ONSET, (before + 22) * PERIOD_NS)
        assert service.status()["missed"] == 0


def test_a_service_that_is_too_slow_now_and_then_says_so_once(
    calm_namespace: Namespace, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hand, service = Hand(), CalmService("hand", into=calm_namespace, state_path=tmp_path / "state.npz")
    counts = iter(3 * ([2] * 20 + [1] * 20))

    def publish_faster() -> None:
        count = next(counts, None)
        if count is None:
            service.stop()
        else:
            hand.publish(count)

    with hand.writer, caplog.at_level(logging.WARNING):
        hand.publish(1)
        service.run(publish_faster, 0.0)
    assert caplog.text.count("samples come faster than they can be taken") == 1


def test_a_tool_gets_the_newest_sample_and_then_each() -> None:
    hand = Hand()
    with hand.writer, DriverReader("hand") as reader:
        hand.publish(3)
        samples = frames_until(reader, lambda: False)
        assert next(samples).sequence == 3
        hand.publish(3)
        assert [next(samples).sequence for _ in range(3)] == [4, 5, 6]
        hand.publish(2)
        assert next(frames_until(reader, lambda: False)).sequence == 8


def test_a_pose_belongs_to_the_newest_sample(tmp_path: Path) -> None:
    hand, paired = Hand(), []
    publications = iter([1, 1, 3, 0, 0])

    class Noting(PressSession):
        def take(self, time_ns: int, load: npt.NDArray[Any], pose: npt.NDArray[np.float64] | None) -> None:
            paired.append(time_ns // PERIOD_NS)

        def is_complete(self, share: float) -> bool:
            count = next(publications, None)
            hand.publish(count or 0)
            return count is None

    class Poses:
        def newest(self) -> npt.NDArray[np.float64]:
            return np.zeros(3)

    with hand.writer, DriverReader("hand") as reader:
        source, poses = LoadSource(reader.structure, "calm"), cast("PoseSource", Poses())
        Gathering(reader, Noting(N), source, poses, tmp_path / "state", as_json=True).run("", 1.0, None)
    assert paired == [1, 2, 5]


@pytest.mark.thorough
def test_a_process_that_was_stopped_publishes_each_sample_once(calm_namespace: Namespace, tmp_path: Path) -> None:
    hand = Hand()
    options = "--into", calm_namespace.name, "--state", str(tmp_path / "state.npz")
    with hand.writer, running("skin-calm", "hand", *options) as calm:
        hand.publish(1)
        calm.wait_for("ready")
        with DriverReader("hand", namespace=calm_namespace) as reader:
            samples = reader.in_order(timeout_s=60)
            assert next(samples).acquired_ns == PERIOD_NS
            for count in 10, 60:
                first = hand.writer.sequence + 1
                calm.process.send_signal(signal.SIGSTOP)
                hand.publish(count)
                calm.process.send_signal(signal.SIGCONT)
                stamps = [next(samples).acquired_ns for _ in range(count)]
                assert stamps == [(first + number) * PERIOD_NS for number in range(count)]
            calm.process.send_signal(signal.SIGSTOP)
            hand.publish(200)
            calm.process.send_signal(signal.SIGCONT)
            last_ns = hand.writer.sequence * PERIOD_NS
            stamps = []
            for sample in samples:
                stamps.append(sample.acquired_ns)
                if stamps[-1] == last_ns:
                    break
            assert stamps == list(range(stamps[0], last_ns + 1, PERIOD_NS))
            status = calm.wait_for("status", lambda status: status["sequence"] == sample.sequence)
            assert status["missed"] == 200 - len(stamps)
            assert status["frames"] == 71 + len(stamps)
