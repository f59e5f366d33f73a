"""The parts of a bridge that are arithmetic: clocks, modes, messages, endpoints, and frames one after the other."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware import DriverReader, DriverWriter, Sample
from skinware.bridge.clock import QUESTIONS, Exchange, PeerClock
from skinware.bridge.endpoints import Rules, endpoints, why_unreachable
from skinware.bridge.messages import (
    CODED,
    RAW,
    About,
    FrameMessage,
    Keys,
    coded_message,
    generation_message,
    raw_message,
    split_frame,
    split_generation,
)
from skinware.bridge.pacing import Pacing
from skinware.bridge.parts import ServiceFile
from skinware.errors import BadRecording, BridgeError, ConfigurationError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.service import ServiceReader
from skinware.transfer.codec import CodedColumn, FrameDecoder, FrameEncoder
from tests.bridge.rig import publish, structure
from tests.streams.peers import free_port

MS = 1_000_000


# -- clock --------------------------------------------------------------------------------------------------------


class Peers:
    """Two clocks, and questions between them as a joiner asks them: ways of 0.15 ms and more, each of its own length.

    Args:
        offset_ns, drift: of ours to the other, from the 5th second of ours on.
    """

    def __init__(self, offset_ns: float, drift: float, seed: int = 1) -> None:
        self.clock = PeerClock()
        self.at_ns: float = 5 * NS_PER_S
        self.offset_ns, self.drift = offset_ns, drift
        self._generator = np.random.default_rng(seed)

    def ask(self) -> None:
        """Some questions at once; then it is the time of the next ones."""
        for number in range(QUESTIONS):
            asked_ns = self.at_ns + number * 30_000
            there_ns, back_ns = 150_000 + self._generator.exponential(200_000, 2)
            heard_ns, returned_ns = asked_ns + there_ns, asked_ns + there_ns + 20_000 + back_ns
            there = (self._other(heard_ns), self._other(heard_ns + 20_000))
            self.clock.add(Exchange.of(round(asked_ns), *there, round(returned_ns)))
        self._pass(self.clock.pause_ns())

    def wrong_ns(self) -> float:
        """What we believe to be known, but is not so."""
        return abs(self.clock.offset_ns(round(self.at_ns)) - self.offset_ns)

    def _pass(self, ns: float) -> None:
        self.at_ns += ns
        self.offset_ns += self.drift * ns

    def _other(self, ns: float) -> int:
        return round(ns - self.offset_ns - self.drift * (ns - self.at_ns))


@pytest.mark.thorough
@pytest.mark.parametrize("offset_ns", [0, 100 * MS, -3 * 3600 * NS_PER_S])
@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6])
def test_the_other_clock_is_found_and_its_error_told_at_every_moment(offset_ns: float, drift: float) -> None:
    peers = Peers(offset_ns, drift)
    while peers.at_ns < 65 * NS_PER_S:
        peers.ask()
        assert peers.wrong_ns() <= peers.clock.error_ns
        if peers.at_ns > 35 * NS_PER_S:
            assert peers.wrong_ns() < 50_000
            assert peers.clock.error_ns < 150_000 + 100_000  # what no clock can know, and some more


@pytest.mark.thorough
def test_the_error_stays_true_when_the_drift_changes() -> None:
    peers = Peers(0, 5e-6)
    for drift in (5e-6, 40e-6, -60e-6, 0):
        peers.drift = drift
        until_ns = peers.at_ns + 40 * NS_PER_S
        changed_ns = peers.at_ns
        while peers.at_ns < until_ns:
            peers.ask()
            if peers.at_ns - changed_ns > 31 * NS_PER_S:  # no moment before is looked at any more
                assert peers.wrong_ns() <= peers.clock.error_ns < MS


@pytest.mark.parametrize("by_ns", [7 * NS_PER_S, -300 * MS, 5 * MS])
def test_a_clock_that_jumps_is_found_again(by_ns: int) -> None:
    peers = Peers(0, 0)
    while peers.at_ns < 30 * NS_PER_S:
        peers.ask()
    peers.offset_ns += by_ns
    for _ in range(4):
        peers.ask()
    assert peers.wrong_ns() <= peers.clock.error_ns < MS


# -- push or pull -------------------------------------------------------------------------------------------------

PERIOD_NS = 10 * MS


def test_it_begins_by_asking_and_is_pushed_where_the_link_is_fast() -> None:
    pacing = Pacing(PERIOD_NS)
    assert pacing.mode == "pull"
    assert pacing.wants_probe(0, MS)
    assert pacing.probed(0, MS)
    assert pacing.mode == "push"
    assert not pacing.wants_probe(NS_PER_S, MS)


def test_a_slow_link_is_tried_again_ever_more_rarely() -> None:
    pacing, at_ns, tried = Pacing(PERIOD_NS), 0, []
    while at_ns < 1000 * NS_PER_S:
        if pacing.wants_probe(at_ns, MS):
            assert not pacing.probed(at_ns, 90 * MS)
            tried.append(at_ns)
        at_ns += NS_PER_S // 4
    assert pacing.mode == "pull"
    gaps = np.diff(tried)
    assert gaps.max() >= 300 * NS_PER_S
    assert len(tried) < 25


def test_one_slow_frame_of_three_tells_nothing() -> None:
    pacing = Pacing(PERIOD_NS)
    assert not pacing.probed(0, 80 * MS)
    assert not pacing.probed(1, 70 * MS)
    assert pacing.probed(2, 2 * MS)


def test_pushed_frames_that_grow_old_are_asked_for() -> None:
    pacing = Pacing(PERIOD_NS)
    assert pacing.probed(0, MS)
    at_ns = 0
    while not pacing.arrived(at_ns, 2 * MS, MS) and at_ns < 10 * NS_PER_S:
        at_ns += PERIOD_NS
    assert pacing.mode == "push"
    while not pacing.arrived(at_ns, 50 * MS, MS):
        at_ns += PERIOD_NS
        assert at_ns < 13 * NS_PER_S
    assert pacing.mode == "pull"
    assert not pacing.wants_probe(at_ns + NS_PER_S, MS)


@pytest.mark.parametrize("delay_ns", [20 * MS, 100 * MS, 300 * MS])
def test_delay_alone_is_no_reason_to_ask_for_single_frames(delay_ns: int) -> None:
    pacing = Pacing(PERIOD_NS, size=5_000)
    assert pacing.wants_probe(0, 2 * delay_ns)
    assert pacing.probed(0, MS)
    at_ns = 0
    for jitter_ns in np.random.default_rng(3).integers(0, 20 * MS, 3000).tolist():
        assert not pacing.arrived(at_ns, delay_ns + jitter_ns, 2 * delay_ns)
        at_ns += PERIOD_NS


def test_a_large_frame_is_no_probe_of_a_long_link() -> None:
    pacing = Pacing(PERIOD_NS, size=170_000)
    assert pacing.wants_probe(0, MS)
    assert not pacing.wants_probe(0, 200 * MS)


def asked_at_once(pacing: Pacing, until_ns: int, wait_of: Callable[[int], int], round_trip_ns: int) -> Iterator[int]:
    """How many questions are open after each frame; ``wait_of``: how long a frame waits with so many, ns."""
    at_ns = 0
    while at_ns < until_ns:
        pacing.arrived(at_ns, round_trip_ns // 2 + wait_of(pacing.open), round_trip_ns)
        at_ns += max(PERIOD_NS, round_trip_ns // pacing.open)
        yield pacing.open


@pytest.mark.parametrize(("round_trip_ns", "wanted"), [(MS // 5, 3), (40 * MS, 10), (600 * MS, 92)])
def test_as_many_questions_are_open_as_a_round_trip_has_periods(round_trip_ns: int, wanted: int) -> None:
    assert list(asked_at_once(Pacing(PERIOD_NS, "pull"), 20 * NS_PER_S, lambda _: 0, round_trip_ns))[-1] == wanted


def test_no_more_questions_are_open_than_the_link_takes() -> None:
    """A link with a round trip of 0.2 s that takes a frame every 40 ms: a sixth one waits."""
    pacing = Pacing(PERIOD_NS, "pull")
    seen = list(asked_at_once(pacing, 400 * NS_PER_S, lambda count: 40 * MS * max(0, count - 5), 200 * MS))
    later = seen[len(seen) // 2 :]
    assert 4 <= np.mean(later) <= 7
    assert max(later) <= 9


@pytest.mark.parametrize("mode", ["push", "pull"])
def test_frames_behind_a_lost_packet_are_no_queue(mode: str) -> None:
    """Each second some frames in a row come a round trip late, at once."""
    pacing, at_ns = Pacing(PERIOD_NS, "pull" if mode == "pull" else None), 0
    if mode == "push":
        assert pacing.probed(0, MS)
    for number in range(4000):
        late_ns = max(0, 120 * MS - number % 20 * PERIOD_NS)
        pacing.arrived(at_ns, 50 * MS + late_ns, 100 * MS)
        at_ns += PERIOD_NS
    assert pacing.mode == mode
    assert mode == "push" or pacing.open == 22


def test_a_moment_of_waiting_changes_little() -> None:
    pacing = Pacing(PERIOD_NS, "pull")
    list(asked_at_once(pacing, 20 * NS_PER_S, lambda _: 0, 200 * MS))
    wanted = pacing.open
    pacing.arrived(21 * NS_PER_S, 900 * MS, 200 * MS)
    pacing.arrived(22 * NS_PER_S, 900 * MS, 200 * MS)
    assert pacing.open == wanted


@pytest.mark.parametrize("mode", ["push", "pull"])
def test_a_mode_that_a_person_wants_stays(mode: str) -> None:
    pacing = Pacing(PERIOD_NS, mode)
    assert not pacing.wants_probe(0, MS)
    assert not any(pacing.arrived(at_ns, NS_PER_S, MS) for at_ns in range(0, 9 * NS_PER_S, PERIOD_NS))
    assert pacing.mode == mode


# -- messages -----------------------------------------------------------------------------------------------------


def test_frames_and_generations_come_as_they_were(namespace: Namespace) -> None:
    with DriverWriter("arm", structure(), namespace=namespace, rate_hz=50) as writer:
        publish(writer, 7)
        with ServiceReader("arm", namespace=namespace) as reader:
            frame = reader.read()
            message = raw_message(frame)
            assert split_frame(message) == (RAW, frame.generation, frame.slot, False)
            encoder = FrameEncoder([CodedColumn.of(column) for column in reader._ring.segment.layout.slot])
            coded = encoder.encode(frame)
            for keeps in (True, False):
                expected = FrameMessage(CODED, frame.generation, memoryview(coded), keeps)
                assert split_frame(coded_message(coded, keeps)) == expected
    about = About({"tare": "Take the present load as none."})
    head = ServiceFile("arm", b"head" * 1000)
    assert split_generation(generation_message(about, head.packed)) == (about, head.raw)
    assert head.packed is head.packed, "it is packed once for all who ask"


@given(st.binary(max_size=200))
def test_random_bytes_are_refused_and_nothing_else(message: bytes) -> None:
    for read in (split_frame, split_generation):
        with contextlib.suppress(BridgeError):
            read(message)


def test_frames_one_after_the_other_are_those_that_were_coded(namespace: Namespace) -> None:
    generator = np.random.default_rng(2)
    with DriverWriter("arm", structure(256), namespace=namespace, rate_hz=50) as writer:
        publish(writer, 1)
        with DriverReader("arm", namespace=namespace) as reader:
            segment = reader._ring.segment
            columns = [CodedColumn.of(column) for column in segment.layout.slot]
            encoder, decoder = FrameEncoder(columns), FrameDecoder(columns, segment.layout.slot_stride)
            for number in range(60):
                frames = writer.begin(from_last=True)
                frames["values"][:] = generator.integers(0, 65536, 256) if number % 3 else 5
                frames["module_time_ns"][:] += generator.integers(0, 1 << 40)
                writer.commit(1 + number)
                frame = reader.read()
                if number in (20, 21):
                    encoder.next_is_key()
                slot = decoder.decode(encoder.encode(frame))
                assert slot.tobytes() == bytes(frame.slot)
                assert decoder.sequence == frame.sequence
            for _ in range(2):
                assert encoder.encode(_next(writer, reader))
            with pytest.raises(BadRecording, match="which is not here"):
                decoder.decode(encoder.encode(_next(writer, reader)))


def _next(writer: DriverWriter, reader: DriverReader) -> Sample:
    publish(writer)
    return reader.read()


@pytest.mark.parametrize("name", ["", "a/b", "*", "my robot", "x" * 48, "-r"])
def test_what_is_no_name_of_a_robot_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match="letters, digits"):
        Keys(name)


# -- endpoints ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", ["192.168.1.1:7448", "tcp/host", "tcp/host:0", "tcp/host:99999", "udp/host:1", "tcp/a b:1"]
)
def test_what_is_no_endpoint_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="give tcp/HOST:PORT"):
        endpoints(connect=[text])


@pytest.mark.parametrize(
    "place", ["tcp/0.0.0.0:7448", "tcp/[::]:7448", "tcp/192.168.1.10:7448", "tcp/robot.local:7448"]
)
def test_nothing_listens_beyond_this_machine_without_a_word(place: str) -> None:
    with pytest.raises(ConfigurationError, match="give --tls DIR, or --insecure"):
        endpoints(listen=[place])
    assert endpoints(listen=[place], insecure=True).listen == [place]


@pytest.mark.parametrize("place", ["tcp/127.0.0.1:7448", "tcp/localhost:7448", "tcp/[::1]:7448"])
def test_this_machine_may_always_be_listened_on(place: str) -> None:
    assert endpoints(listen=[place]).listen == [place]


def test_certificates_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"ca\.pem: No such file"):
        endpoints(listen=["tcp/0.0.0.0:7448"], tls=tmp_path)
    with pytest.raises(ConfigurationError, match="give --tls"):
        endpoints(listen=["tls/0.0.0.0:7448"])
    with pytest.raises(ConfigurationError, match="give --tls, too"):
        endpoints(listen=["tcp/127.0.0.1:7448"], rules=Rules(callers=["operator"]))


def test_why_nobody_is_reached() -> None:
    assert "nothing listens there" in why_unreachable(f"tcp/127.0.0.1:{free_port()}", None)
    assert "tcp/no.such.host.invalid:7448: " in why_unreachable("tcp/no.such.host.invalid:7448", None)
