"""Dex3 hands on topics of DDS, published by a program of Cyclone DDS alone; and the bus, whatever publishes."""

from __future__ import annotations

import asyncio
import json
import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the extra ros2")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from skinware import DriverReader, DriverSnapshot, Namespace
from skinware.errors import ConfigurationError, MissingExtra
from skinware.status import BusState, Status
from skinware_drivers.bus import FrameBatch
from skinware_drivers.link import Link
from skinware_drivers.registry import make_bus
from skinware_drivers.streams import dds
from skinware_drivers.streams.dds import DdsBus, record, samples
from skinware_drivers.streams.dex3 import Dex3Driver, Dex3Options
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.commands import Running, refused, run, running
from tests.ros2.alone import own_domain
from tests.sdk.driving import follow, has_come, later_than
from tests.streams.dex3_peer import LEAST, PADS, TAXELS, Edition, pressure, temperature

N = 2 * TAXELS * PADS


@pytest.fixture
def domain(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> int:
    return own_domain(namespace, monkeypatch)


@contextmanager
def robot(domain: int, *options: str) -> Iterator[Running]:
    with running("python", "-m", "tests.streams.dex3_peer", str(domain), *options) as there:
        there.wait_for("ready")
        yield there


def driven(domain: int, **options: Any) -> Any:
    return emulated_skin("dex3", bus=f"dds://{domain}", driver_options=options)


def expected(number: int, hand: int) -> list[float]:
    return [
        value
        for pad in range(PADS)
        for value in (
            *(pressure(number, hand, pad, taxel) for taxel in range(TAXELS)),
            *(temperature(number, pad),) * TAXELS,
        )
    ]


def number_of(frame: DriverSnapshot, hand: int, start: int = 0) -> int:
    return int(frame.values[start]) - LEAST - 1000 * hand


def require_exact(frame: DriverSnapshot, hands: tuple[int, ...] = (0, 1)) -> None:
    for place, hand in enumerate(hands):
        values = frame.values[place * N : (place + 1) * N]
        assert values.tolist() == expected(number_of(frame, hand, place * N), hand)


def is_good(frame: DriverSnapshot) -> bool:
    return not frame.status.any()


def test_both_hands_value_by_value(domain: int) -> None:
    with robot(domain), driven(domain) as skin:
        frame = read_until(skin.reader, is_good)
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"left hand", b"right hand"]
        assert structure.module_name.tolist()[:2] == [b"thumb pad", b"thumb tip"]
        assert len(structure.sensor_uid) == 2 * N
        assert [(kind.name, kind.unit) for kind in structure.types] == [
            ("pressure", "counts"),
            ("temperature", "counts"),
        ]
        for _ in range(20):
            require_exact(frame)
            frame = read_until(skin.reader, later_than(frame))


@pytest.mark.thorough
def test_nothing_is_lost_at_500_hz_beside_a_second_reader(domain: int) -> None:
    count = 1000
    ours = DomainParticipant(domain)
    hand = Edition().hand
    seconds = [DataReader(ours, Topic(ours, f"rt/dex3/{side}/state", hand)) for side in ("left", "right")]
    seen = 0
    with (
        driven(domain, hands="both") as skin,
        robot(domain, "--hz", "500", "--count", str(count)) as there,
    ):
        read_until(skin.reader, is_good)
        there.process.send_signal(signal.SIGUSR1)
        there.wait_for("silent")
        frame = read_until(skin.reader, lambda f: bool((f.status & Status.STALE).all()))
        before = skin.reader.bus_counters(frame)[0]["frames"]
        there.process.send_signal(signal.SIGUSR1)
        while number_of(frame, 0) < count - 1 or number_of(frame, 1, N) < count - 1:
            require_exact(frame)
            seen += sum(len(second.take(1000)) for second in seconds)
            frame = read_until(skin.reader, later_than(frame))
        there.wait_for("done")
        frame = read_until(skin.reader, lambda f: skin.reader.bus_counters(f)[0]["frames"] == before + 2 * PADS * count)
        [counters] = skin.reader.bus_counters(frame)
        assert [counters[name] for name in ("dropped", "refused", "bad_length")] == [0, 0, 0]
        assert [each["sequence_lost"] for each in skin.reader.patch_counters(frame)] == [0, 0]
        assert seen > 0


def test_missing_pads_and_losses(domain: int) -> None:
    with robot(domain, "--missing", "4", "--losing", "2"), driven(domain) as skin:
        lost = slice(24 * 2, 24 * 3)
        frame = read_until(skin.reader, lambda f: (f.status[lost] == Status.SUSPECT).all())
        status = frame.status[:N].reshape(PADS, 24)
        assert (status[4, :12] == Status.NOT_CONNECTED).all()
        assert not status[4, 12:].any()
        assert not status[[0, 1, 3, 5, 6, 7, 8]].any()
        read_until(skin.reader, lambda f: not f.status[lost].any())
        assert skin.reader.patch_counters(frame)[0]["sequence_lost"] > 0


def test_one_hand_then_the_other(domain: int) -> None:
    with robot(domain, "--hands", "left"), driven(domain) as skin:
        frame = read_until(skin.reader, is_good)
        assert frame.structure.patch_name.tolist() == [b"left hand"]
        with robot(domain, "--hands", "right"):
            frame = follow(skin.reader, lambda f: len(f.values) == 2 * N and is_good(f))
            require_exact(frame)


def test_a_robot_that_restarts(domain: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with driven(domain, hands="left") as skin:
        with robot(domain, "--hands", "left"):
            read_until(skin.reader, is_good)
        wait_until(lambda: "a publisher of rt/dex3/left/state is gone" in caplog.text)
        read_until(skin.reader, lambda f: bool((f.status & Status.STALE).all()))
        caplog.clear()
        with robot(domain, "--hands", "left", "--first", "5000"):
            frame = read_until(skin.reader, lambda f: is_good(f) and number_of(f, 0) >= 5000)
            require_exact(frame, (0,))
            assert "a publisher of rt/dex3/left/state is there" in caplog.text
            assert BusState(int(frame.bus_state[0])) == BusState.LIVE


def test_of_two_publishers_the_first_is_read(domain: int, caplog: pytest.LogCaptureFixture) -> None:
    with driven(domain, hands="left") as skin:
        with robot(domain, "--hands", "left"):
            read_until(skin.reader, is_good)
            with robot(domain, "--hands", "left", "--first", "500000"):
                wait_until(lambda: "rt/dex3/left/state has 2 publishers: only the first is read" in caplog.text)
                frame = read_until(skin.reader, lambda f: any(c["refused"] > 20 for c in skin.reader.bus_counters(f)))
                assert number_of(frame, 0) < 500_000
                require_exact(frame, (0,))


@pytest.mark.parametrize("edition", ["old", "swapped"])
def test_other_editions_of_the_type(domain: int, edition: str, caplog: pytest.LogCaptureFixture) -> None:
    with driven(domain, hands="left") as skin, robot(domain, "--hands", "left", "--edition", edition):
        if edition == "old":
            require_exact(read_until(skin.reader, is_good), (0,))
        else:
            wait_until(lambda: "cannot be read: its type unitree_hg::msg::dds_::HandState_ has another" in caplog.text)
            assert not skin.reader.bus_counters(skin.reader.read())[0]["frames"]


def test_a_sample_of_the_right_type_with_another_number_of_motors(
    domain: int, caplog: pytest.LogCaptureFixture
) -> None:
    with driven(domain, hands="left") as skin, robot(domain, "--hands", "left", "--motors", "6"):
        read_until(skin.reader, lambda f: skin.reader.bus_counters(f)[0]["bad_length"] > 5)
        assert "left hand: 6 motors and" in caplog.text


def _swapped(sample: bytes, size: int) -> bytes:
    """The same bytes as another HandState_ has them, whose publisher does not show its type."""
    pads, imu = sample[4 + 396 : 4 + 400 + PADS * size], sample[4 + 400 + PADS * size :][:56]
    return sample[: 4 + 396] + imu + pads + sample[4 + 396 + len(pads) + 56 :]


@pytest.mark.parametrize("edition", ["new", "old"])
def test_plausibility(edition: str) -> None:
    driver = Dex3Driver(Dex3Options())
    good = Edition(edition).sample(77, 1).serialize()
    size = (len(good) - 4 - 400 - 56 - 32) // PADS
    assert (size, len(list(driver._split(1, bytes(4) + good)))) == (104 if edition == "new" else 96, PADS)
    at = 4 + 400 + PADS * size
    bad = [
        _swapped(good, size),
        good[:-4],
        b"",
        good[: at + 1] + b"\x7f\x7f\x7f\x7f" + good[at + 5 :],
        b"\0\0" + good[2:],
        *(bytes(np.random.default_rng(seed).bytes(len(good))) for seed in range(50)),
    ]
    for sample in bad:
        [(identifier, body)] = driver._split(1, bytes(4) + sample)
        assert (identifier, len(body)) == (0x110, 4)
    assert driver._split(9, bytes(4) + good) == [(0x110, bytes(4))]


def test_what_waits_is_bounded_and_counted(domain: int) -> None:
    bus = make_bus(f"dds://{domain}?depth=40", payload_size=2048)
    assert isinstance(bus, DdsBus)
    bus.topics = Dex3Driver(Dex3Options(hands="left")).topics
    bus.use(samples(2048))
    bus.open()
    try:
        ours = DomainParticipant(domain)
        edition = Edition()
        writer = DataWriter(ours, Topic(ours, "rt/dex3/left/state", edition.hand))
        wait_until(lambda: writer.get_publication_matched_status().current_count == 1)
        for number in range(100):
            writer.write(edition.sample(number, 0))
        batch = FrameBatch(64, 2048)
        assert bus.receive(batch, 0) <= 16
        wait_until(lambda: bus.receive(batch, 0) >= 0 and batch.stop == 40)
        bus.receive(batch, 0)
        assert bus.counters.dropped == 60
        body = batch.wire["payload"][0][: batch.wire["length"][0]].tobytes()
        assert body[4:] == Edition().sample(0, 0).serialize()
    finally:
        bus.close()


def test_records_and_their_framing() -> None:
    framer = samples(2048).framer()
    data = b"noise" + record(3, 123_450_000, b"\0\1\0\0abcd")
    [frame] = [one for at in range(len(data)) for one in framer.feed(data[at : at + 1])]
    assert (frame.identifier, frame.body) == (3, (12345).to_bytes(4, "little") + b"\0\1\0\0abcd")


@pytest.mark.parametrize("name", ["dds://", "dds://x", "dds://233", "dds://0?qos=perhaps", "dds://0?depth=0"])
def test_wrong_names(name: str) -> None:
    with pytest.raises(ConfigurationError):
        make_bus(name)


def test_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dds, "find_spec", lambda _name: None)
    with pytest.raises(MissingExtra, match=r"pip install 'skinware\[ros2\]'"):
        make_bus("dds://0")


def test_a_driver_without_topics() -> None:
    done = refused("skin-driver", "--driver", "skintalk", "--bus", "dds://0")
    assert done.returncode == 2
    assert "reads no topics" in done.stderr


@pytest.mark.parametrize("names", ["0", "9=palm", "x=palm", "1="])
def test_wrong_names_of_pads(names: str) -> None:
    with pytest.raises(ConfigurationError, match="write NUMBER=NAME"):
        Dex3Options(names=(names,))


class Described:
    """Both hands with these options: names of pads, by hand, and places."""

    def __init__(self, **options: Any) -> None:
        driver = Dex3Driver(Dex3Options(hands="both", **options))
        patches = asyncio.run(driver.join(cast("Link", None), ()))
        self.names = [[module.name for module in patch.modules] for patch in patches]
        assert driver.geometry is not None
        self.geometry = driver.geometry

    def at(self, hand: int, pad: int, type_name: str = "pressure") -> np.ndarray[Any, np.dtype[np.float64]]:
        """(12, 2) m, right and up, as a person sees the palm."""
        uids = np.arange(hand << 8 | pad << 4, hand << 8 | pad << 4 | 12, dtype=np.uint64)
        return self.geometry.at([type_name] * 12, uids).position_m[:, :2]


def test_pads_lie_where_owners_found_them() -> None:
    hands = Described()
    left, right = ({name: pad for pad, name in enumerate(names)} for names in hands.names)
    assert (left["palm index"], left["palm middle"]) == (right["palm middle"], right["palm index"]) == (6, 8)
    at = {name: hands.at(1, pad).mean(axis=0) for name, pad in right.items()}
    assert at["index tip"][0] > 0 > at["middle tip"][0]
    assert at["palm index"][0] > at["palm centre"][0] > at["palm middle"][0]
    heights = [at[name][1] for name in ("index tip", "index pad", "palm index", "thumb pad", "thumb tip")]
    assert heights == sorted(heights, reverse=True)  # the thumb is folded down
    for name, pad in left.items():
        assert np.allclose(hands.at(0, pad).mean(axis=0), at[name] * [-1, 1])
        assert np.array_equal(hands.at(0, pad), hands.at(0, pad, "temperature"))


def test_taxels_lie_as_in_an_owners_table() -> None:
    def corners(pad: int) -> list[list[float]]:
        places = Described().at(1, pad)
        signs: list[list[float]] = np.sign((places - places.mean(axis=0))[[0, 2, 9, 11]]).tolist()
        return signs

    assert corners(4) == [[1, -1], [-1, -1], [1, 1], [-1, 1]]
    assert corners(0) == [[-1, 1], [1, 1], [-1, -1], [1, -1]]
    assert corners(6) == [[1, 1], [1, -1], [-1, 1], [-1, -1]]
    tip = Described().at(1, 5)
    assert tip[3, 1] > tip[6, 1] == tip[8, 1]
    assert tip[6, 0] < tip[8, 0]


def test_a_name_moves_a_pad() -> None:
    usual, other = Described(), Described(names=("0=middle tip", "4=nail"), pads=10)
    assert np.array_equal(other.at(1, 0), usual.at(1, 3))
    assert other.names[1][:6] == ["middle tip", "thumb tip", "middle pad", "pad 3", "nail", "index tip"]
    assert other.names[1][9] == "pad 9"
    assert all(np.isnan(other.at(1, pad)).all() for pad in (3, 4, 9))


@pytest.mark.thorough
def test_the_commands(domain: int, tmp_path: Path) -> None:
    """The emulated hands are found, read, captured and replayed."""
    with running("skin-emulate", "--driver", "dex3", "--bus", f"dds://{domain}", "--period-ms", "10") as emulated:
        emulated.wait_for("ready")
        [bus] = json.loads(run("skin-find", f"dds://{domain}", "--probe", "--json").stdout)["buses"]
        assert bus["topics"] == [
            {
                "topic": f"rt/dex3/{side}/state",
                "type_name": "unitree_hg::msg::dds_::HandState_",
                "publishers": 1,
                "drivers": ["dex3"],
            }
            for side in ("left", "right")
        ]
        assert bus["probe"]["answers"] == {"dex3": "Unitree Dex3-1: left, right"}
        assert "read by dex3" in " ".join(run("skin-find", f"dds://{domain}").stdout.split())
        capture = f"{tmp_path}/hands.mcap"
        options = ("--names", "0=thumb tip", "--capture", capture)
        with running("skin-driver", "--driver", "dex3", "--bus", f"dds://{domain}", *options) as driver:
            assert driver.wait_for("ready")["sensors"] == 2 * N
            driver.wait_for("status", lambda event: event["buses"][0]["frames"] > 1000)
    with running("skin-driver", "--bus", f"replay:{capture}") as replayed:
        assert replayed.wait_for("ready")["sensors"] == 2 * N
        with DriverReader("dex3") as reader:
            frame = read_until(reader, has_come)
            assert b"thumb tip" in frame.structure.module_name.tolist()
            assert (frame.physical("pressure") >= LEAST).all()
