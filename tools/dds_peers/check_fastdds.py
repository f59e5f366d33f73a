"""Sends our messages to a program with Fast DDS, and compares every byte that comes there: see tools/fastdds."""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from skinware import DriverReader, DriverWriter, Namespace, Structure
from skinware.conversion import ros_messages
from skinware.conversion.showing import Showing
from skinware.conversion.tables import sensor_names
from skinware.geometry import Geometry
from skinware.ros2 import messages
from skinware.ros2.transport import Distro, MessageType, NodeIdentity, Qos
from skinware.sensor_types import PRESSURE

if TYPE_CHECKING:
    from skinware.ros2.dds import DdsNode

PATIENCE_S = 30.0
PERIOD_S = 0.05
SERVICE = "/skin/check/tare"
ENCAPSULATION = bytes.fromhex("00010000")


class Peer:
    """The program, and what it got."""

    def __init__(self, program: Path, domain: int) -> None:
        self.process = subprocess.Popen([program, str(domain)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.messages: dict[str, list[bytes]] = defaultdict(list)
        self.data: dict[str, str] = {}
        self.readers: dict[str, str] = {}
        assert self.process.stdout is not None
        self._thread = threading.Thread(target=self._read, args=(self.process.stdout,))
        self._thread.start()

    def listen(self, topic: str, message_type: MessageType, *, latched: bool = False) -> None:
        self._say(topic, message_type.dds_name, "latched" if latched else "volatile")

    def send(self, topic: str, dds_type: str, message: bytes, times: int = 1) -> None:
        self._say(topic, dds_type, "send", message.hex(), str(times))

    def _say(self, *words: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{' '.join(words)}\n".encode())
        self.process.stdin.flush()

    def end(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(PATIENCE_S)
        self._thread.join()

    def _read(self, out: IO[bytes]) -> None:
        for line in out:
            what, topic, more = line.decode().rstrip("\n").split(" ", 2)
            if what == "W":
                self.data[topic] = more
            elif what == "R":
                self.readers[topic] = more
            else:
                self.messages[topic].append(out.read(int(more)))


def structure(modules: int) -> Structure:
    """Modules of 12 taxels at places; one in four is a grid."""
    n = 12 * modules
    geometry = Geometry.unknown(["pressure"] * n, np.arange(n, dtype=np.uint64))
    geometry.position_m[:] = np.random.default_rng(1).random((n, 3))
    geometry.frame[:] = "forearm"
    return Structure(
        types=[PRESSURE.measured(unit="counts", minimum=0, maximum=65535)],
        buses=["can0"],
        patch_name=[f"board {number}" for number in range(-(-modules // 16))],
        patch_bus=[0] * -(-modules // 16),
        module_patch=np.arange(modules) // 16,
        module_kind=["3x4" if module < 16 else "triangle" for module in range(modules)],
        sensor_uid=np.arange(n),
        sensor_type=[PRESSURE.id] * n,
        sensor_module=np.arange(n) // 12,
        dtype="u2",
        geometry=geometry,
    )


def made(modules: int, count: int) -> list[tuple[str, MessageType, Qos, list[bytes]]]:
    """Topics with the messages that are sent there."""
    of, name = structure(modules), f"size{modules}"
    showing = Showing(name, of)
    topics: dict[str, list[bytes]] = {topic: [] for topic in showing.topics}
    frames: list[bytes] = []
    place = Namespace()
    with DriverWriter(name, of, namespace=place) as writer, DriverReader(name, namespace=place) as reader:
        for number in range(count):
            columns = writer.begin()
            values: npt.NDArray[np.uint16] = columns["values"]
            values[:] = np.random.default_rng(number).integers(0, 65536, len(values))
            columns["module_time_ns"][:] = time.monotonic_ns()
            writer.commit(time.monotonic_ns())
            frame = reader.read()
            frames.append(ros_messages.skin_frame(frame, time.time_ns()))
            for picture in showing.pictures(frame, time.time_ns()):
                topics[picture.topic].append(picture.data)
        sensors = ros_messages.sensors(of, sensor_names(of), frame.generation, time.time_ns())
    return [
        *((topic, messages.OF_SCHEMAS[showing.topics[topic].name], Qos(), sent) for topic, sent in topics.items()),
        (f"/skin/{name}/frame", messages.SKIN_FRAME, Qos(), frames),
        (f"/skin/{name}/sensors", messages.SENSORS, Qos(depth=1, latched=True), [sensors]),
    ]


def check_service(peer: Peer, node: DdsNode) -> tuple[list[str], bool]:
    """Look whether the program finds a service of the node, and call it as rmw_cyclonedds does."""
    asked: list[bytes] = []

    def answer(request: bytes) -> bytes:
        asked.append(request)
        return messages.trigger_response(True, "done")

    node.service(SERVICE, messages.TRIGGER, answer)
    request, reply = messages.TRIGGER.request, messages.TRIGGER.response
    ask, told = f"rq{SERVICE}Request", f"rr{SERVICE}Reply"
    peer.listen(told, reply)
    wait_for(lambda: told in peer.data and ask in peer.readers)
    is_seen = told in peer.data and peer.readers.get(ask) == request.dds_name
    lines = [f"service {SERVICE}: {'seen' if is_seen else 'NOT seen'}, its request is {peer.readers.get(ask)}"]
    identity = bytes(range(16))
    peer.send(ask, request.dds_name, ENCAPSULATION + identity + bytes(4))
    wait_for(lambda: bool(peer.messages[told]))
    answers = [message[: len(ENCAPSULATION) + 16] for message in peer.messages[told]]
    is_answered = answers == [ENCAPSULATION + identity] and len(asked) == 1
    lines.append(
        f"called with an identity before the request (rmw_cyclonedds): {'answered' if is_answered else 'NOT answered'}"
    )
    return lines, is_seen and is_answered


def wait_for(condition: Callable[[], bool]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < until_s:
        time.sleep(PERIOD_S)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program", type=Path)
    parser.add_argument("--messages", type=int, default=60)
    options = parser.parse_args()
    domain = random.randint(1, 99)
    os.environ["CYCLONEDDS_URI"] = (
        "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>8</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
        "</Domain></CycloneDDS>"
    )
    from skinware.ros2.dds import DdsNode

    topics = [each for modules in (2, 64, 2572) for each in made(modules, options.messages)]
    peer, node = Peer(options.program, domain), DdsNode(NodeIdentity("check", domain=domain))
    try:
        publishers = [node.publisher(topic, message_type, qos) for topic, message_type, qos, _ in topics]
        for topic, message_type, qos, _ in topics:
            peer.listen(f"rt{topic}", message_type, latched=qos.latched)
        until_s = time.monotonic() + PATIENCE_S
        volatile = [each for each, (_, _, qos, _) in zip(publishers, topics, strict=True) if not qos.latched]
        while not all(each.is_wanted for each in volatile) and time.monotonic() < until_s:
            time.sleep(PERIOD_S)
        time.sleep(1.0)  # that the other end knows of us, too
        refused = 0
        for number in range(options.messages):
            for publisher, (_, _, _, sent) in zip(publishers, topics, strict=True):
                if number < len(sent):
                    refused += not publisher.publish(sent[number])
            time.sleep(PERIOD_S)
        wanted = sum(len(sent) for *_, sent in topics)
        while sum(map(len, peer.messages.values())) < wanted - refused and time.monotonic() < until_s:
            time.sleep(PERIOD_S)
        service_lines, is_good = check_service(peer, node)
    finally:
        node.close()
        peer.end()
    is_good &= not refused
    print(f"{refused} of {wanted} messages were not taken by the carrier")
    for topic, message_type, _, sent in topics:
        came = peer.messages[f"rt{topic}"]
        padded = [message + bytes(-len(message) % 4) for message in sent]
        equal = sum(one in padded for one in came)
        hash_told = peer.data.get(f"rt{topic}") == messages.endpoint_data(message_type.hash, Distro.JAZZY).decode()
        is_good &= came == padded and hash_told
        print(
            f"{message_type.name:32} {len(sent[0]):8} B: {len(sent):3} sent, {len(came):3} came, {equal:3} byte-equal,"
            f" hash {'told' if hash_told else 'NOT told'}   {topic}"
        )
    for line in service_lines:
        print(line)
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
