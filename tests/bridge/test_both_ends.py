"""Services of one namespace appear in another, whatever the network does."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Skin
from skinware.bridge.link import Question
from skinware.bridge.messages import FrameMessage, split_frame
from skinware.bridge.streaming import FrameStream
from skinware.errors import Paused, PeerGone, RequestError, RequestFailed, RequestRefused, StructureChanged
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.service import ServiceReader, ServiceWriter
from skinware.transfer.codec import HEADER, CodedColumn
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.net import NetLink
from tests.bridge.rig import ROBOT, Ends, joined, publish, serving, structure

PATIENCE_S = 10.0


@pytest.fixture(params=["push", "pull"])
def ends(namespace: Namespace, request: pytest.FixtureRequest) -> Iterator[Ends]:
    with joined(namespace, request.param) as ends:
        yield ends


def driver(namespace: Namespace, name: str = "arm", sensors: int = 64) -> DriverWriter:
    return DriverWriter(name, structure(sensors), namespace=namespace, rate_hz=50)


def reader(ends: Ends, name: str = "arm") -> DriverReader:
    return DriverReader(name, namespace=ends.here, timeout_s=PATIENCE_S)


def until_appeared(ends: Ends, writer: DriverWriter, value: int | None = 1) -> None:
    """A frame that is published after both ends know each other arrives."""

    def has_arrived() -> bool:
        publish(writer, value)
        try:
            with DriverReader(writer.name, namespace=ends.here) as reader:
                return bool(reader.newest_position) and not reader.read().stale
        except Exception:  # noqa: BLE001, not there yet
            return False

    wait_until(has_arrived)


taken: dict[str, set[int]] = {}
"""The values of frames that were taken of a driver; each frame has a value of its own."""


def take(there: DriverReader) -> int:
    value = int(there.read().values[0])
    taken.setdefault(there.name, set()).add(value)
    return value


@pytest.fixture(autouse=True)
def nothing_taken() -> None:
    taken.clear()


def test_a_driver_is_the_same_here(ends: Ends) -> None:
    with serving(ends.net, ends.there), driver(ends.there) as writer:
        until_appeared(ends, writer)
        with reader(ends) as there, DriverReader("arm", namespace=ends.there) as beside:
            assert there.structure == beside.structure
            assert there.schema == beside.schema
            for value in range(100, 110):
                publish(writer, value)
                wait_until(lambda value=value: int(there.read().values[0]) == value)  # type: ignore[misc]
                frame = there.read()
                assert (frame.values == value).all()
                assert frame.fresh("pressure", at_ns=frame.acquired_ns).all()
                assert frame.acquired_ns == pytest.approx(beside.read().acquired_ns, abs=5e9)  # the error of the clocks


def test_every_frame_comes_and_what_is_lost_is_counted_exactly(namespace: Namespace) -> None:
    with joined(namespace, "push") as ends, serving(ends.net, ends.there), driver(ends.there) as writer:
        until_appeared(ends, writer, None)
        with reader(ends) as there:
            first = take(there)
            generator = np.random.default_rng(5)
            for _ in range(300):
                is_lost = bool(generator.random() < 0.3)
                ends.net.loses = lambda kind, _key, is_lost=is_lost: is_lost and kind == "frame"  # type: ignore[misc]
                asked = ends.net.offered
                sequence = publish(writer)
                wait_until(lambda asked=asked: ends.net.offered > asked)  # type: ignore[misc]
                if not is_lost:
                    until_read(there, sequence)
            ends.net.loses = lambda _kind, _key: False
            until_read(there, publish(writer))
            assert there.missed + len(taken[there.name]) == writer.sequence - first + 1


def test_a_pulled_frame_is_the_difference_to_one_that_is_kept_and_comes_once(namespace: Namespace) -> None:
    with joined(namespace, "pull") as ends, serving(ends.net, ends.there), driver(ends.there) as writer:
        until_appeared(ends, writer, None)
        with reader(ends) as there:
            ends.net.answered.clear()
            for _ in range(20):
                until_read(there, publish(writer))
        messages = [split_frame(answer) for key, answer in ends.net.answered if key.endswith("/newest") and answer]
        pulled = [(head_of(message), message.keeps) for message in messages]
    sequences = [int(header["sequence"]) for header, _ in pulled]
    kept = {int(header["sequence"]) for header, keeps in pulled if keeps}
    others = [int(header["after"]) for header, keeps in pulled if not keeps]
    assert set(others) - {0, *kept} <= {min(others)}, "kept before this test looked"
    assert sum(after > 0 for after in others) > len(others) / 2  # all, unless something was asked for again
    assert len(set(sequences)) > 0.75 * len(sequences)


def head_of(message: FrameMessage) -> np.void:
    head: np.void = np.frombuffer(message.content, HEADER, 1)[0]
    return head


class Asked:
    """A question of a puller, with its answers."""

    def __init__(self, others: int, base: int = 0) -> None:
        self.answers: list[FrameMessage] = []
        parameters = {"who": "x", "others": str(others), "base": str(base)}
        self.question = Question("", parameters, b"", lambda payload: self.answers.append(split_frame(payload)), _fail)


def _fail(error: bytes) -> None:
    raise AssertionError(error)


def test_each_of_several_open_questions_has_a_frame_of_its_own(namespace: Namespace) -> None:
    class NoSender:
        is_heard = False

    stream = FrameStream(NoSender(), lambda work, *arguments: work(*arguments))  # type: ignore[arg-type]
    with driver(namespace) as writer, ServiceReader[Sample]("arm", namespace=namespace) as reader:
        publish(writer)
        first = reader.read()
        stream.begin(first.generation, [CodedColumn.of(column) for column in reader._ring.segment.layout.slot])
        asked = [Asked(others) for others in range(4)]
        for question in asked:
            stream.asked(question.question)
        for _ in range(5):
            stream.take(reader.read())
            publish(writer)
        heads = [head_of(question.answers[0]) for question in asked]
        assert [int(head["sequence"]) for head in heads] == [1, 2, 3, 4]
        assert [question.answers[0].keeps for question in asked] == [True, False, False, False]
        again = [Asked(0, base=1), Asked(1, base=1), Asked(2, base=99)]
        for question in again:
            stream.asked(question.question)
        for _ in range(2):
            stream.take(reader.read())
            publish(writer)
        heads = [head_of(question.answers[0]) for question in again]
        assert [int(head["sequence"]) for head in heads] == [5, 6, 7]
        assert [int(head["after"]) for head in heads] == [1, 1, 0], "who does not have the frame gets a whole one"


def until_read(there: DriverReader, value: int) -> None:
    """Until a reader has the frame of a value."""
    wait_until(lambda: take(there) == value)


def test_a_killed_driver_is_dead_here_and_comes_back(ends: Ends) -> None:
    with serving(ends.net, ends.there):
        writer = driver(ends.there)
        until_appeared(ends, writer)
        with reader(ends) as there:
            writer.desert()
            wait_until(lambda: not there.alive)
            assert there.read().stale
            with driver(ends.there) as again:
                until_appeared(ends, again, 9)
                wait_until(lambda: there.read().values[0] == 9)
                assert not there.read().stale


def test_a_driver_that_ends_is_gone_here(ends: Ends) -> None:
    with serving(ends.net, ends.there):
        with driver(ends.there) as writer:
            until_appeared(ends, writer)
        wait_until(lambda: "arm" not in ends.here.services())


def test_another_structure_is_never_seen_under_the_old_one(ends: Ends) -> None:
    with serving(ends.net, ends.there):
        with driver(ends.there) as writer:
            until_appeared(ends, writer)
        with driver(ends.there, sensors=64) as writer:
            until_appeared(ends, writer)
            with reader(ends) as there:
                there.read()
                known = there.structure
                writer.restructure(structure(128))
                publish(writer, 3)
                with pytest.raises(StructureChanged):
                    there.read(newer_than=(1 << 62, 0), timeout_s=PATIENCE_S)
                there.reattach()
                assert known.n_sensors == 64
                assert there.read(timeout_s=PATIENCE_S).values.shape == (128,)


def test_the_network_is_cut_and_heals(ends: Ends) -> None:
    with serving(ends.net, ends.there), driver(ends.there) as writer:
        until_appeared(ends, writer, None)
        with reader(ends) as there:
            first = take(there)
            ends.net.is_cut = True
            wait_until(lambda: not there.alive)
            for _ in range(20):
                publish(writer)
            ends.net.is_cut = False
            wait_until(lambda: ends.joiner.is_connected)
            until_read(there, publish(writer))
            assert there.missed + len(taken[there.name]) == writer.sequence - first + 1
    events = [event["event"] for event in ends.events if event["event"] in ("connected", "disconnected")]
    assert events[:3] == ["connected", "disconnected", "connected"]


@pytest.mark.thorough
def test_the_bridge_of_the_robot_ends_and_another_begins(ends: Ends) -> None:
    with driver(ends.there) as writer:
        with serving(ends.net, ends.there):
            until_appeared(ends, writer)
            there = reader(ends)
        with there:
            wait_until(lambda: not there.alive)
            with serving(ends.net, ends.there):
                until_appeared(ends, writer, 6)
                wait_until(lambda: there.read().values[0] == 6)


def test_a_frame_that_was_published_long_ago_is_here(ends: Ends) -> None:
    with driver(ends.there) as writer:
        publish(writer, 11)
        with serving(ends.net, ends.there), reader(ends) as there:
            wait_until(lambda: there.newest_position is not None and int(there.read().values[0]) == 11)


def test_a_pause_is_seen_here(ends: Ends) -> None:
    with serving(ends.net, ends.there), driver(ends.there) as writer:
        until_appeared(ends, writer)
        with reader(ends) as there:
            writer.pause()
            wait_until(lambda: there.refresh() is not None and there.paused)
            with pytest.raises(Paused):
                there.request(timeout_s=PATIENCE_S)
            writer.resume()
            until_appeared(ends, writer)
            wait_until(lambda: there.refresh() is not None and not there.paused)


class Tared:
    def __init__(self) -> None:
        self.called: list[dict[str, object]] = []

    def tare(self, gently: bool = False) -> dict[str, object]:
        """Take the present load as none."""
        self.called.append({"gently": gently})
        return {"tared": 3, "gently": gently}

    def fail(self) -> None:
        """Never works."""
        raise RuntimeError("the valve is stuck")


def test_operations_are_those_of_the_robot(ends: Ends) -> None:
    device = Tared()
    operations: dict[str, Callable[..., object]] = {"tare": device.tare, "fail": device.fail}
    with (
        serving(ends.net, ends.there),
        ServiceWriter("pump", {"x": ("<f8", 2)}, namespace=ends.there, operations=operations, rate_hz=50) as writer,
    ):
        import threading

        def work() -> None:
            for columns in writer.periodic(50):
                columns["x"][:] = 2.0

        thread = threading.Thread(target=work)
        thread.start()
        try:
            with ServiceReader("pump", namespace=ends.here, timeout_s=PATIENCE_S) as there:
                wait_until(lambda: there.newest_position is not None)
                assert there.operations() == {"tare": "Take the present load as none.", "fail": "Never works."}
                assert there.call("tare", gently=True, timeout_s=PATIENCE_S) == {"tared": 3, "gently": True}
                assert device.called == [{"gently": True}]
                with pytest.raises(RequestFailed, match="the valve is stuck"):
                    there.call("fail", timeout_s=PATIENCE_S)
                with pytest.raises(RequestRefused, match="no operation 'dance'"):
                    there.call("dance", timeout_s=PATIENCE_S)
                frame = there.request(timeout_s=PATIENCE_S)
                assert frame.column("x").tolist() == [2.0, 2.0]
                ends.net.loses = lambda kind, key: kind == "question" and "/call/" in key
                with pytest.raises(RequestError):
                    there.call("tare", timeout_s=0.3)
                pending = there.ask("acquire")
                ends.net.is_cut = True
                with pytest.raises(PeerGone):
                    pending.result(PATIENCE_S)
        finally:
            writer.stop()
            thread.join()


@pytest.mark.thorough
def test_a_generation_that_is_asked_for_in_vain_is_asked_for_again(ends: Ends) -> None:
    lost: list[str] = []

    def loses(kind: str, key: str) -> bool:
        if kind in ("question", "reply") and key.endswith("/generation") and not lost:
            lost.append(key)
            return True
        return False

    ends.net.loses = loses
    with serving(ends.net, ends.there), driver(ends.there) as writer:
        until_appeared(ends, writer)
        assert lost


def test_what_is_served_twice_or_in_another_version_is_told(ends: Ends) -> None:
    with serving(ends.net, ends.there), driver(ends.there) as writer:
        until_appeared(ends, writer)
        other = NetLink(ends.net)
        other.declare_token(f"skinware/live/{ROBOT}/2/00000000000000ab")
        wait_until(lambda: any("version 2 of the bridge" in event.get("why", "") for event in ends.events))
        with serving(ends.net, Namespace(f"{ends.there.name}-other")):
            wait_until(lambda: any("served by two bridges" in event.get("why", "") for event in ends.events))
        other.close()


def test_a_name_that_is_in_use_here_is_told(ends: Ends) -> None:
    with driver(ends.here) as own, serving(ends.net, ends.there), driver(ends.there) as writer:
        publish(own, 1)

        def is_told() -> bool:
            publish(writer, 2)
            return any("cannot appear here" in event.get("why", "") for event in ends.events)

        wait_until(is_told)
        with reader(ends) as there:
            assert there.read().values[0] == 1


def test_a_skin_here_has_all_drivers_there(ends: Ends) -> None:
    with serving(ends.net, ends.there), driver(ends.there, "left") as left, driver(ends.there, "right") as right:
        until_appeared(ends, left, 5)
        until_appeared(ends, right, 6)
        with Skin(namespace=ends.here) as skin:
            assert skin.read().physical("pressure").shape == (128,)
