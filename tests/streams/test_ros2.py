"""Topics of ROS 2 as a skin: every known message by programs of Cyclone DDS alone, maps, and whatever else comes."""

from __future__ import annotations

import contextlib
import json
import logging
import random
import re
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the extra ros2")

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.topic import Topic

from skinware import DriverReader, DriverSnapshot, Namespace
from skinware.errors import BusError, ConfigurationError
from skinware.ros_types import Definitions
from skinware.status import Status
from skinware_drivers.streams.cdr import CdrMessage
from skinware_drivers.streams.dds import record
from skinware_drivers.streams.ros2 import Ros2Driver, Ros2Options
from skinware_drivers.streams.ros2_parts import FieldRule, by_rules
from skinware_drivers.streams.ros2_presets import PRESETS, TEXTS
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.commands import refused, run, running
from tests.ros2.alone import own_domain
from tests.sdk.driving import follow, has_come, is_whole, later_than
from tests.streams.ros2_peer import (
    CASES,
    RAW_XELA,
    Case,
    Channel,
    Header,
    TactileState,
    Talker,
    Time,
    Vector3,
    case_of,
    header,
    message,
    ramp,
    same,
    serialized,
)

_ALL = [*CASES, RAW_XELA]


@pytest.fixture
def domain(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> int:
    return own_domain(namespace, monkeypatch)


@contextlib.contextmanager
def published(domain: int, case: Case, topic: str = "rt/touch", **more: Any) -> Iterator[Talker]:
    participant, sample = DomainParticipant(domain), more.pop("sample", case.sample)
    writer = DataWriter(participant, Topic(participant, topic, case.idl_type))
    with Talker(lambda number: writer.write(sample(number)), **more) as talker:
        yield talker


def driven(domain: int, **options: Any) -> Any:
    return emulated_skin("ros2", bus=f"dds://{domain}", driver_options={"learn_s": 0.2, **options})


def test_every_known_message_has_its_peer() -> None:
    assert [case.type_name for case in CASES] == list(PRESETS)


@pytest.mark.parametrize("case", _ALL, ids=lambda case: case.type_name + str(case is RAW_XELA))
def test_each_message_value_by_value(domain: int, case: Case) -> None:
    with published(domain, case) as program, driven(domain) as skin:
        frame = read_until(skin.reader, is_whole)
        structure = frame.structure
        assert [kind.decode() for kind in structure.module_kind] == list(case.kinds)
        assert frame.values.dtype == case.dtype
        for _ in range(5):
            assert any(same(frame.values, case.shown(number)) for number in range(program.number + 1))
            frame = read_until(skin.reader, later_than(frame))


@pytest.mark.parametrize("case", _ALL, ids=lambda case: case.type_name + str(case is RAW_XELA))
def test_each_message_cut_anywhere_is_no_message(case: Case) -> None:
    driver, sample = Ros2Driver(Ros2Options(topic=(f"/t={case.type_name}",))), serialized(case.sample(7))
    [number] = [topic.number for topic in driver.topics]
    for size in range(len(sample) - 4):
        [(_, body)] = driver._split(number, bytes(4) + sample[:size])
        assert len(body) == 4
    [(identifier, _)] = driver._split(number, bytes(4) + sample)  # news of its modules
    assert identifier == 0


def test_places_of_points(domain: int) -> None:
    with published(domain, case_of("sensor_msgs/msg/PointCloud2")), driven(domain) as skin:
        geometry = read_until(skin.reader, is_whole).structure.geometry
        assert geometry is not None
        pressures = geometry.type_name == "pressure"
        expected = [[0.5 * n, 1, 2] for n in range(5)]
        assert geometry.position_m[pressures][:5].tolist() == expected
        assert np.isnan(geometry.position_m[pressures][5]).all()
        assert set(geometry.frame[geometry.known]) == {"palm"}


def test_places_and_normals_of_taxels(domain: int) -> None:
    with published(domain, case_of("paxini_hardware/msg/TactileSensor")), driven(domain) as skin:
        geometry = read_until(skin.reader, is_whole).structure.geometry
        assert geometry is not None
        rows = np.flatnonzero(geometry.known & (geometry.type_name == "force_z"))
        assert geometry.position_m[rows, 0].tolist() == [0, 0.001, 0.002]
        assert geometry.normal[rows, 2].tolist()[1:] == [1, 1]
        assert np.isnan(geometry.normal[rows[0]]).all()


def test_a_topic_that_alone_falls_silent(domain: int) -> None:
    case = case_of("tactile_msgs/msg/TactileState")
    with (
        published(domain, case, "rt/left") as left,
        published(domain, case, "rt/right"),
        driven(domain, topic=("/left", "/right")) as skin,
    ):
        read_until(skin.reader, lambda f: len(f.values) == 16 and is_whole(f))
        left.is_silent = True
        frame = read_until(skin.reader, lambda f: bool((f.status[:8] & Status.STALE).all()))
        assert frame.structure.patch_name.tolist() == [b"/left", b"/right"]
        last = frame.sequence
        frame = read_until(skin.reader, lambda f: f.sequence > last + 20)
        assert (frame.status[:8] & Status.STALE).all()
        assert not (frame.status[8:] & Status.STALE).any()


def test_a_sensor_that_a_message_leaves_out(domain: int) -> None:
    case, both = case_of("tactile_msgs/msg/TactileState"), threading.Event()
    both.set()

    def sample(number: int) -> Any:
        sensors = [Channel("thumb", ramp(number, 4)), Channel("index", ramp(-number, 4))]
        return TactileState(header(number), sensors if both.is_set() else sensors[1:])

    with published(domain, case, sample=sample), driven(domain) as skin:
        read_until(skin.reader, lambda f: len(f.values) == 8 and is_whole(f))
        both.clear()
        frame = read_until(skin.reader, lambda f: bool((f.status[:4] & Status.STALE).all()))
        assert not frame.status[4:].any()
        both.set()
        read_until(skin.reader, is_whole)


def test_modules_that_come_later_and_in_another_form(domain: int) -> None:
    case = case_of("tactile_msgs/msg/TactileState")
    sensors = {"thumb": 4}

    def sample(number: int) -> Any:
        return TactileState(header(number), [Channel(name, ramp(number, n)) for name, n in sensors.items()])

    with published(domain, case, sample=sample), driven(domain) as skin:
        read_until(skin.reader, lambda f: len(f.values) == 4 and is_whole(f))
        sensors["index"] = 3
        frame = follow(skin.reader, lambda f: len(f.values) == 7 and is_whole(f))
        assert frame.structure.module_name.tolist() == [b"thumb", b"index"]
        sensors["thumb"] = 6
        follow(skin.reader, lambda f: len(f.values) == 9 and is_whole(f))


def test_two_types_on_one_topic_and_a_type_that_is_not_known(domain: int, caplog: pytest.LogCaptureFixture) -> None:
    other = message("my_msgs", "Hand", data=idl.sequence[idl.float32])
    stranger = Case("my_msgs/msg/Hand", other, lambda n: other(ramp(n, 3)), lambda n: ramp(n, 3), [])
    caplog.set_level(logging.INFO)
    with published(domain, stranger), published(domain, case_of("std_msgs/msg/UInt16")), driven(domain) as skin:
        frame = read_until(skin.reader, is_whole)
        assert len(frame.values) == 1
        assert "cannot be read: its type is my_msgs::msg::dds_::Hand_, not one of" in caplog.text


def test_nothing_is_published_and_only_one_type_is_asked_for(domain: int) -> None:
    ours = DomainParticipant(domain)
    publications = BuiltinDataReader(ours, BuiltinTopicDcpsPublication)
    subscriptions = BuiltinDataReader(ours, BuiltinTopicDcpsSubscription)
    with published(domain, case_of("std_msgs/msg/Float32MultiArray")), driven(domain) as skin:
        read_until(skin.reader, is_whole)
        [reader] = [one for one in subscriptions.take(100) if not one.topic_name.startswith("DCPS")]
        assert (reader.topic_name, reader.type_name) == ("rt/touch", "std_msgs::msg::dds_::Float32MultiArray_")
        assert re.fullmatch(rb"\w+=\w+;", reader.qos[Policy.Userdata].data)  # without it, rmw_cyclonedds warns
        assert len({one.participant_key for one in publications.take(100)}) == 1


def test_the_time_of_the_header(domain: int) -> None:
    case = case_of("sensor_msgs/msg/FluidPressure")

    taken_ns: dict[int, int] = {}

    def sample(number: int) -> Any:
        made = case.sample(number)
        taken_ns[number] = time.monotonic_ns() - 3_000_000 * (number % 2)  # of every other, 3 ms before it is sent
        made.header = Header(Time(*divmod(taken_ns[number], 10**9)), "palm")
        return made

    recent: deque[tuple[int, int]] = deque(maxlen=4)

    def follows_the_header(frame: DriverSnapshot) -> bool:
        if is_whole(frame):
            number = int(frame.values[0])
            recent.append((int(frame.module_time_ns[0]) - taken_ns[number], number % 2))
        apart_ns = [distance_ns for distance_ns, _ in recent]
        return len(recent) == 4 and max(apart_ns) - min(apart_ns) < 1_000_000 and {odd for _, odd in recent} == {0, 1}

    with published(domain, case, sample=sample), driven(domain, time="header", topic=("/touch",)) as skin:
        read_until(skin.reader, follows_the_header)


MAP = """
format = "skinware-ros2-map"
version = 1

[[topic]]
name = "/hand"
type = "my_msgs/msg/Hand"

[[topic.values]]
field = ["fingers.tip.x", "fingers.tip.z"]
quantity = ["shear_x", "pressure"]
unit = ["mN", "counts"]
each = "fingers"
module = "{fingers.name}"
patch = "left hand"
status = "!fingers.good"

[[topic.values]]
field = "palm"
patch = "left hand"
taxels = [2, 3]
quantity = "warmth"
unit = "K"
number = "seq"

[[topic]]
name = "/plain"
type = "std_msgs/msg/Float32MultiArray"

[definition]
"my_msgs/Hand" = '''
std_msgs/Header header   # a comment
uint8 OTHER=1
Finger[<=5] fingers
float64[6] palm
bool dummy false
uint8 seq
'''
"my_msgs/Finger" = '''
string name
geometry_msgs/Vector3 tip
bool good
'''
"""
_Finger = message("my_msgs", "Finger", name=str, tip=Vector3, good=bool)
_Hand = message(
    "my_msgs",
    "Hand",
    header=Header,
    fingers=idl.sequence[_Finger, 5],
    palm=idl.array[idl.float64, 6],
    dummy=bool,
    seq=idl.uint8,
)


def _hand(number: int) -> Any:
    fingers = [_Finger(name, Vector3(number, -1, number / 4), name != "thumb") for name in ("thumb", "index")]
    return _Hand(header(number), fingers, ramp(number, 6), True, (number + number // 4) % 256)  # one in five is lost


_HAND = Case("my_msgs/msg/Hand", _Hand, _hand, lambda n: [n, n / 4] * 2 + ramp(n, 6), [])


def test_a_map(domain: int, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(MAP)
    plain = case_of("std_msgs/msg/Float32MultiArray")
    with (
        published(domain, _HAND, "rt/hand") as program,
        published(domain, plain, "rt/plain"),
        driven(domain, map=str(path)) as skin,
    ):
        frame = read_until(skin.reader, lambda f: len(f.values) == 22 and is_whole(f))
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"left hand", b"/plain"]
        assert structure.module_name.tolist() == [b"thumb", b"index", b"palm", b"array"]
        units = {kind.name: kind.unit for kind in structure.types}
        assert units == {"shear_x": "mN", "pressure": "counts", "warmth": "K"}
        assert any(same(frame.values[:10], _HAND.shown(number)) for number in range(program.number + 1))
        assert (frame.status[:2] == Status.SUSPECT).all()
        assert not frame.status[2:].any()
        later = read_until(skin.reader, lambda f: f.values[4] > frame.values[4] + 250)
        lost = [skin.reader.patch_counters(each)[0]["sequence_lost"] for each in (frame, later)]
        assert 40 < lost[1] - lost[0] <= 1 + (later.values[4] - frame.values[4]) / 4  # a silence hides some


def test_a_quantity_in_two_units_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text(MAP.replace('"mN", "counts"', '"mN", "kPa"'))
    driver, plain = Ros2Driver(Ros2Options(map=str(path))), case_of("std_msgs/msg/Float32MultiArray")
    for topic, sample in zip(driver.topics, (_hand(1), plain.sample(1)), strict=True):
        driver._split(topic.number, bytes(4) + serialized(sample))
    driver._collect()
    with pytest.raises(BusError, match="array of /plain: pressure in counts, and elsewhere in kPa"):
        driver._describe()


def test_a_map_that_is_missing(domain: int, tmp_path: Path) -> None:
    done = refused("skin-driver", "--driver", "ros2", "--map", f"{tmp_path}/none.toml", "--bus", f"dds://{domain}")
    assert done.returncode == 2
    assert "none.toml: No such file" in done.stderr


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("float64[6] palm", "float64{6} palm"), "'float64{6} palm' is no field"),
        (('"my_msgs/Finger"', '"my_msgs/Thumb"'), "definition of type my_msgs/Finger is missing"),
        (("bool good", "Hand hand"), "is within itself"),
        (('type = "std_msgs/msg/Float32MultiArray"', 'type = "std_msgs/msg/Header"'), "need a map"),
        (('[[topic.values]]\nfield = "palm"', '[[topic.values]]\nfields = "palm"'), "fields"),
    ],
)
def test_wrong_maps(tmp_path: Path, change: tuple[str, str], why: str) -> None:
    path = tmp_path / "map.toml"
    path.write_text(MAP.replace(*change))
    with pytest.raises(ConfigurationError, match=re.escape(why)) as raised:
        Ros2Options(map=str(path))
    assert f"{path}:" in str(raised.value)


@pytest.mark.parametrize("topic", ["/t=std_msgs/msg/Nonsense", "/t=std_msgs/Int8"])
def test_wrong_types(topic: str) -> None:
    with pytest.raises(ConfigurationError, match="are not known"):
        Ros2Options(topic=(topic,))


def test_fields_that_a_map_names_and_messages_lack(tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    for change in (
        ('field = "palm"', 'field = "sole"'),
        ("taxels = [2, 3]", "taxels = 7"),
        ('"!fingers.good"', '"palm"'),
        *(('"seq"', f'"{name}"') for name in ("none", "palm", "fingers.tip.x")),
    ):
        path.write_text(MAP.replace(*change))
        driver = Ros2Driver(Ros2Options(map=str(path)))
        [(_, body)] = driver._split(driver.topics[0].number, bytes(4) + serialized(_hand(1)))
        assert len(body) == 4
        assert driver.troubles


def test_version_2_of_the_encoding_and_the_other_byte_order() -> None:
    driver = Ros2Driver(Ros2Options(topic=("/t=tactile_msgs/msg/TactileState",)))
    [number] = [topic.number for topic in driver.topics]
    case = case_of("tactile_msgs/msg/TactileState")
    for data in (case.sample(3).serialize(use_version_2=True), case.sample(3).serialize()):
        assert [identifier for identifier, _ in driver._split(number, bytes(4) + data)] == [0]
        values = [np.frombuffer(part.body(data), part.dtype).tolist() for part in driver._plans[number].parts]
        assert [value for each in values for value in each] == case.shown(3)
    big = b"\0\0\0\0" + np.array([1.5], ">f8").tobytes()
    single = Ros2Driver(Ros2Options(topic=("/t=std_msgs/msg/Float64",)))
    [of_single] = [topic.number for topic in single.topics]
    single._split(of_single, bytes(4) + big)
    assert single._plans[of_single].parts[0].body(big) == np.array([1.5], "<f8").tobytes()
    wide = b"\0\0\0\0" + np.array([-2], ">i8").tobytes()
    message = CdrMessage(wide, Definitions("std_msgs/msg/Int64", TEXTS))
    [part] = by_rules(FieldRule("data", number="data"))(message, "/t")
    assert part.body(wide) == np.array([-2], "<i8").tobytes() + b"\xfe\xff\xff\xff"


@pytest.mark.parametrize("case", _ALL, ids=lambda case: case.type_name + str(case is RAW_XELA))
def test_damaged_samples_never_raise(case: Case) -> None:
    driver = Ros2Driver(Ros2Options(topic=(f"/t={case.type_name}",)))
    [number] = [topic.number for topic in driver.topics]
    rng, good = random.Random(5), serialized(case.sample(9))
    for _ in range(300):
        sample = bytearray(good)
        for _ in range(rng.randint(1, 4)):
            at = 4 + 4 * rng.randrange(max(1, (len(sample) - 4) // 4))
            sample[at : at + 4] = rng.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"\1\0\0\0", rng.randbytes(4)))
        for identifier, body in driver._split(number, bytes(4) + bytes(sample)):
            assert identifier <= 0x7FF
            assert len(body) <= driver.payload_size


def test_pictures_and_clouds_that_would_fill_the_memory() -> None:
    driver = Ros2Driver(Ros2Options(topic=("/t=sensor_msgs/msg/Image", "/t=sensor_msgs/msg/PointCloud2")))
    image, cloud = (case_of(f"sensor_msgs/msg/{name}") for name in ("Image", "PointCloud2"))
    for case, topic in zip((image, cloud), driver.topics, strict=True):
        for height, width, step in ((2**32 - 1, 2**32 - 1, 0), (2**31, 1, 0), (1, 2**32 - 1, 0), (0, 3, 8)):
            sample = case.sample(1)
            sample.height, sample.width = height, width
            if case is image:
                sample.step = step
            else:
                sample.point_step = sample.row_step = step
            [(_, body)] = driver._split(topic.number, bytes(4) + serialized(sample))
            assert len(body) == 4


def test_a_large_picture_becomes_several_modules(domain: int) -> None:
    case = case_of("sensor_msgs/msg/Image")

    def sample(number: int) -> Any:
        made = case.sample(number)
        made.height, made.width, made.encoding, made.step, made.is_bigendian = 100, 90, "mono8", 90, 0
        made.data = [(number + n) % 256 for n in range(9000)]
        return made

    with published(domain, case, sample=sample), driven(domain) as skin:
        frame = read_until(skin.reader, is_whole)
        assert frame.structure.module_kind.tolist() == [b"45x90", b"45x90", b"10x90"]
        assert frame.values.tolist() == [(int(frame.values[0]) + n) % 256 for n in range(9000)]


def test_topics_that_are_not_there(domain: int) -> None:
    with published(domain, case_of("std_msgs/msg/Int8"), "rt/other"):
        with running("skin-driver", "--driver", "ros2", "--topic", "/hand", "--bus", f"dds://{domain}") as driver:
            why = "no messages on /hand within 5 s; topics there: /other (std_msgs/msg/Int8)"
            wait_until(lambda: why in " ".join(driver.errors.split()))


@pytest.mark.thorough
def test_a_map_is_written_of_one_message(domain: int, tmp_path: Path) -> None:
    definitions = tmp_path / "my_msgs" / "msg"
    definitions.mkdir(parents=True)
    (definitions / "Hand.msg").write_text(
        "std_msgs/Header header\nFinger[<=5] fingers\nfloat64[6] palm\nbool dummy\nuint8 seq\n"
    )
    path = tmp_path / "map.toml"
    writing = ["write_map", "--driver", "ros2", "--option", "topic=/hand"]
    asking = ("skin-config", f"dds://{domain}", *writing, f"file={path}")
    with published(domain, _HAND, "rt/hand") as program:
        failed = refused(*asking, f"definitions={tmp_path}")
        assert "my_msgs/msg/Finger.msg" in failed.stderr
        (definitions / "Finger.msg").write_text("string name\ngeometry_msgs/Vector3 tip\nbool good\n")
        assert "4 fields of my_msgs/msg/Hand" in " ".join(run(*asking, f"definitions={tmp_path}").stdout.split())
        assert path.read_text().count('number = "seq"') == 4
        with driven(domain, map=str(path)) as skin:
            frame = read_until(skin.reader, is_whole)
            tips = [value for n in range(program.number + 1) for value in [[n, -1, n / 4]]]
            assert frame.values[:3].tolist() in tips


@pytest.mark.thorough
def test_the_commands(domain: int, tmp_path: Path) -> None:
    """Emulated topics are found, read, captured and replayed."""
    with running("skin-emulate", "--driver", "ros2", "--bus", f"dds://{domain}", "--message", "points") as emulated:
        emulated.wait_for("ready")
        [bus] = json.loads(run("skin-find", f"dds://{domain}", "--json").stdout)["buses"]
        [topic] = [each for each in bus["topics"] if each["publishers"]]
        assert (topic["topic"], topic["drivers"]) == ("rt/touch", ["ros2"])
        capture = f"{tmp_path}/touch.mcap"
        with running("skin-driver", "--driver", "ros2", "--bus", f"dds://{domain}", "--capture", capture) as driver:
            assert driver.wait_for("ready")["sensors"] == 24
            driver.wait_for("status", lambda event: event["buses"][0]["frames"] > 200)
    with running("skin-driver", "--bus", f"replay:{capture}") as replayed:
        assert replayed.wait_for("ready")["sensors"] == 24
        with DriverReader("ros2") as reader:
            frame = read_until(reader, has_come)
            assert frame.structure.geometry is not None


def test_samples_that_are_too_long_are_refused(domain: int) -> None:
    case = case_of("std_msgs/msg/UInt8MultiArray")

    def sample(number: int) -> Any:
        made = case.sample(number)
        if number % 10 == 0:
            made.data = [0] * (1 << 20)
        return made

    with published(domain, case, sample=sample), driven(domain) as skin:
        read_until(skin.reader, lambda f: is_whole(f) and skin.reader.bus_counters(f)[0]["refused"] > 0)


def test_names_that_are_too_long_for_a_structure(domain: int) -> None:
    name, case = "thumb_of_the_left_hand_of_the_second_robot", case_of("tactile_msgs/msg/TactileState")

    def sample(number: int) -> Any:
        return TactileState(header(number), [Channel(name + end, ramp(number, 2)) for end in ("_a", "_b")])

    topic = "/robot_2/hands/left/fingers/touch/raw"
    with published(domain, case, f"rt{topic}", sample=sample), driven(domain, topic=(topic,)) as skin:
        structure = read_until(skin.reader, is_whole).structure
        assert structure.patch_name.tolist() == [b"/robot_2/han~t/fingers/touch/raw"]
        assert structure.module_name.tolist() == [
            b"thumb_of_the~_the_second_robot_a",
            b"thumb_of_the~_the_second_robot_b",
        ]


def test_a_record_of_a_topic_that_is_not_known() -> None:
    driver = Ros2Driver(Ros2Options())
    [frame] = driver.framing.framer().feed(record(999, 0, b"\0\1\0\0abcd"))
    assert (frame.identifier, len(frame.body)) == (0x7FF, 4)
