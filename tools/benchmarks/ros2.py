"""Drivers in a ROS 2 graph over DDS: what the bridge costs, and how late messages come to a program of another process.

tools/bench ros2 [--seconds S] [--sensors N ...]

A driver publishes at 100 Hz; the bridge and a subscriber are processes of their own, over loopback. Ages are from the
publication of a frame to the arrival of its message. Cyclone DDS' own way of writing, from objects of Python, is
measured beside ours, in turns.
"""

from __future__ import annotations

import argparse
import os
import random
import struct
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection

import numpy as np
from links import Command
from processes import Processes, answer, own_namespace
from record import LARGE, RATE_HZ, SMALL, driving

from skinware import DriverReader
from skinware.conversion.showing import Showing
from skinware.realtime import now_ns
from skinware.ros2 import messages
from skinware.ros2.transport import MessageType, NodeIdentity, Qos

PATIENCE_S = 30.0
PAUSE_S = 0.05
POINTS, FRAME = "/skin/large/points/pressure", "/skin/large/frame"
_PUBLISHED = slice(44, 52)
"""Where a SkinFrame with no coordinate frame has the time of its publication."""
_STAMP = slice(4, 12)


def alone() -> int:
    """A domain on this machine alone, for all that starts from now on."""
    os.environ["CYCLONEDDS_URI"] = (
        "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>8</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
        "</Domain></CycloneDDS>"
    )
    domain = random.randint(1, 99)
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    return domain


def subscribe(pipe: Connection, domain: int, topics: list[tuple[str, MessageType]]) -> None:
    """Take messages from when the other end says so until it says enough; ages in ns by topic then."""
    from cyclonedds._clayer import ddspy_take
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.qos import Policy
    from cyclonedds.qos import Qos as DdsQos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    from skinware.ros2.dds import _type

    anything = SampleState.Any | ViewState.Any | InstanceState.Any
    participant = DomainParticipant(domain)
    waiting = WaitSet(participant)
    qos = DdsQos(Policy.Reliability.Reliable(max_blocking_time=0), Policy.History.KeepLast(5))
    readers = {
        topic: DataReader(participant, Topic(participant, f"rt{topic}", _type(message_type)), qos)
        for topic, message_type in topics
    }
    for reader in readers.values():
        waiting.attach(ReadCondition(reader, anything))
    ages: dict[str, list[int]] = {topic: [] for topic in readers}
    begun = False
    while True:
        waiting.wait(duration(milliseconds=50))
        for topic, reader in readers.items():
            taken = ddspy_take(reader._ref, anything, 16)
            ages[topic] += [_age_ns(topic, data) for data, info in taken if info.valid_data]
        if not begun and all(ages.values()):
            pipe.send("ready")
            answer(pipe, PATIENCE_S)
            ages, begun = {topic: [] for topic in readers}, True
        elif begun and pipe.poll():
            pipe.send(ages)
            return


def _age_ns(topic: str, data: bytes) -> int:
    if topic == FRAME:
        return now_ns() - int.from_bytes(data[_PUBLISHED], "little")
    seconds, rest_ns = struct.unpack("<iI", data[_STAMP])
    return time.time_ns() - int(seconds) * 10**9 - int(rest_ns)


def measure(sensors: int, seconds: float) -> None:
    print(f"  {sensors} sensors at {RATE_HZ} Hz, {seconds:g} s, load {os.getloadavg()[0]:.1f}")
    wanted: dict[str, list[tuple[str, MessageType]]] = {
        "nobody listens": [],
        "points, 20 Hz": [(POINTS, messages.POINTS)],
        "every frame": [(FRAME, messages.SKIN_FRAME)],
        "both": [(POINTS, messages.POINTS), (FRAME, messages.SKIN_FRAME)],
    }
    for what, topics in wanted.items():
        domain = alone()
        with ExitStack() as stack:
            namespace = stack.enter_context(own_namespace())
            stack.enter_context(driving(namespace.name, sensors, "analogue"))
            bridge = Command("ros2", "--namespace", namespace.name)
            processes = stack.enter_context(Processes())
            pipe = processes.start(subscribe, domain, topics) if topics else None
            if pipe is None:
                time.sleep(2)
            else:
                answer(pipe, PATIENCE_S)
                pipe.send("go")
            bridge.begin()
            time.sleep(seconds)
            share = bridge.share()
            ages: dict[str, list[int]] = {}
            if pipe is not None:
                pipe.send("enough")
                ages = answer(pipe, PATIENCE_S)
            events = bridge.end()
        told = next(event for event in reversed(events) if event["event"] == "status")["drivers"]["large"]
        print(f"    {what:<15} {100 * share:5.1f} % of a core, {told['missed']} lost, {told['left_out']} left out")
        for topic, of_topic in ages.items():
            p50, p99 = (float(np.percentile(of_topic, at)) / 1e6 for at in (50, 99)) if of_topic else (np.nan, np.nan)
            rate = len(of_topic) / seconds
            print(f"        {topic:<30} {rate:6.1f} Hz  age p50 {p50:6.2f} ms, p99 {p99:6.2f} ms", flush=True)


def ways(sensors: int, writes: int = 20) -> None:
    """A point cloud given to Cyclone DDS in both ways, in turns."""
    from skinware.ros2 import cyclone, dds

    domain = alone()
    with ExitStack() as stack:
        namespace = stack.enter_context(own_namespace())
        stack.enter_context(driving(namespace.name, sensors, "analogue"))
        with DriverReader("large", namespace=namespace, timeout_s=PATIENCE_S) as reader:
            frame = reader.read()
        showing = Showing("large", frame.structure)
        made_s = _median_s(lambda: list(showing.pictures(frame, 0, wanted=POINTS.__eq__)), writes)
        (cloud,) = showing.pictures(frame, 0, wanted=POINTS.__eq__)
        processes = stack.enter_context(Processes())
        pipe = processes.start(subscribe, domain, [(POINTS, messages.POINTS)])
        node = dds.DdsNode(NodeIdentity("bench", domain=domain))
        publisher = node.publisher(POINTS, messages.POINTS, Qos())
        while not pipe.poll(0.05):
            publisher.publish(cloud.data)
        answer(pipe, PATIENCE_S)
        pipe.send("go")
        write_bytes = cyclone.write_bytes
        taken_s: dict[bool, list[float]] = {True: [], False: []}
        for _ in range(writes):
            for is_bytes, of_way in taken_s.items():
                cyclone.write_bytes = write_bytes if is_bytes else None
                time.sleep(PAUSE_S)
                of_way.append(_median_s(lambda: publisher.publish(cloud.data), 1))
        cyclone.write_bytes = write_bytes
        pipe.send("enough")
        answer(pipe, PATIENCE_S)
        node.close()
    as_bytes_ms, as_objects_ms = (float(np.median(of_way)) * 1e3 for of_way in taken_s.values())
    print(
        f"  a cloud of {sensors} points, {len(cloud.data) / 1e3:.0f} kB: made in {made_s * 1e3:.2f} ms,"
        f" written as bytes in {as_bytes_ms:.2f} ms, from objects of Python in {as_objects_ms:.1f} ms"
    )


def _median_s(work: Callable[[], object], count: int) -> float:
    taken = []
    for _ in range(count):
        begin = time.thread_time()  # others that run beside it do not count
        work()
        taken.append(time.thread_time() - begin)
    return float(np.median(taken))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--sensors", type=int, nargs="+", default=[SMALL, LARGE])
    options = parser.parse_args()
    for sensors in options.sensors:
        measure(sensors, options.seconds)
    for sensors in options.sensors:
        ways(sensors)


if __name__ == "__main__":
    main()
