"""Lets a program with Fast DDS publish all that the driver ``ros2`` knows, and compares values: see tools/fastdds."""

from __future__ import annotations

import argparse
import os
import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from check_fastdds import Peer

from skinware.driver_snapshot import DriverSnapshot
from skinware.ros_types import dds_name
from skinware.status import Status
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until
from tests.streams.ros2_peer import CASES, Case, same, serialized

NUMBER, TIMES = 41, 60
_NOT_FRESH = Status.STALE | Status.NEVER_SEEN


def is_fresh(frame: DriverSnapshot) -> bool:
    return not (frame.status & _NOT_FRESH).any()


def check(peer: Peer, domain: int, number: int, case: Case) -> bool:
    """Return whether all values of a message are read as they were published."""
    topic = f"rt/case{number}"
    peer.send(topic, dds_name(case.type_name), serialized(case.sample(NUMBER)), TIMES)
    options = {"topic": (f"/case{number}",), "learn_s": 0.1}
    with emulated_skin("ros2", bus=f"dds://{domain}", driver_options=options) as skin:
        frame = read_until(skin.reader, is_fresh)
        is_good = same(frame.values, case.shown(NUMBER))
    print(f"{case.type_name:40} {len(frame.values):5} values: {'equal' if is_good else 'NOT equal'}")
    return is_good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program", type=Path)
    options = parser.parse_args()
    domain = random.randint(1, 99)
    os.environ["CYCLONEDDS_URI"] = (
        "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>8</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
        "</Domain></CycloneDDS>"
    )
    peer = Peer(options.program, domain)
    try:
        good = sum(check(peer, domain, number, case) for number, case in enumerate(CASES))
    finally:
        peer.process.kill()
        peer.end()
    print(f"{good} of {len(CASES)} messages of Fast DDS are read value by value")
    return 0 if good == len(CASES) else 1


if __name__ == "__main__":
    sys.exit(main())
