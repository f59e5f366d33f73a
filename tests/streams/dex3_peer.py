"""A robot with Dex3 hands, of Cyclone DDS alone: ``python -m tests.streams.dex3_peer DOMAIN``; types by the IDL.

Every value follows from the number of its sample, which is in the first taxel.
"""

from __future__ import annotations

import argparse
import signal
import time
from typing import Any

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

SIDES = ("left", "right")
PADS, TAXELS = 9, 12
LEAST, MOST = 100_000, 1_000_000


def pressure(number: int, hand: int, pad: int, taxel: int) -> float:
    return float(LEAST + (number + 1000 * hand + 12 * pad + taxel) % (MOST - LEAST))


def temperature(number: int, pad: int) -> float:
    return (number % 64 + pad) / 4


class Edition:
    """The types of the hand's state, with ``lost`` or as they were before; or the other order that a page shows."""

    def __init__(self, name: str = "new") -> None:
        def struct(plain: str, **fields: Any) -> Any:
            return make_idl_struct(plain, f"unitree_hg.msg.dds_.{plain}", fields)

        u32, f32 = idl.uint32, idl.float32
        self.has_lost = name != "old"
        self.motor = struct(
            "MotorState_",
            mode=idl.uint8,
            q=f32,
            dq=f32,
            ddq=f32,
            tau_est=f32,
            temperature=idl.array[idl.int16, 2],
            vol=f32,
            sensor=idl.array[u32, 2],
            motorstate=u32,
            reserve=idl.array[u32, 4],
        )
        more = {"lost": u32, "reserve": u32} if self.has_lost else {}
        self.pad = struct("PressSensorState_", pressure=idl.array[f32, 12], temperature=idl.array[f32, 12], **more)
        self.imu = struct(
            "IMUState_",
            quaternion=idl.array[f32, 4],
            gyroscope=idl.array[f32, 3],
            accelerometer=idl.array[f32, 3],
            rpy=idl.array[f32, 3],
            temperature=idl.int16,
        )
        pads, imu = {"press_sensor_state": idl.sequence[self.pad]}, {"imu_state": self.imu}
        middle = imu | pads if name == "swapped" else pads | imu
        self.hand = struct(
            "HandState_",
            motor_state=idl.sequence[self.motor],
            **middle,
            power_v=f32,
            power_a=f32,
            system_v=f32,
            device_v=f32,
            error=idl.array[u32, 2],
            reserve=idl.array[u32, 2],
        )

    def sample(self, number: int, hand: int, *, missing: int = -1, losing: int = -1, motors: int = 7) -> Any:
        """A sample; pad ``missing`` has no reading, pad ``losing`` loses one more in each tenth."""
        motor = self.motor(1, 0.1, 0.2, 0.3, 0.4, [30, 31], 24.0, [1, 2], 3, [0, 0, 0, 0])
        pads = []
        for pad in range(PADS):
            felt = [pressure(number, hand, pad, taxel) for taxel in range(TAXELS)]
            fields: list[Any] = [[30000.0] * TAXELS if pad == missing else felt, [temperature(number, pad)] * TAXELS]
            pads.append(self.pad(*fields, *((number // 10 if pad == losing else 0, 0) if self.has_lost else ())))
        imu = self.imu([0.5, -0.5, 0.5, 0.5], [0.0] * 3, [0.0, 0.0, 9.8], [0.0] * 3, 40)
        power = {"power_v": 24.0, "power_a": 1.0, "system_v": 12.0, "device_v": 5.0}
        return self.hand(
            motor_state=[motor] * motors,
            press_sensor_state=pads,
            imu_state=imu,
            **power,
            error=[0, 0],
            reserve=[0, 0],
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("domain", type=int)
    parser.add_argument("--hands", nargs="*", default=SIDES)
    parser.add_argument("--edition", default="new")
    parser.add_argument("--hz", type=float, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--missing", type=int, default=-1)
    parser.add_argument("--losing", type=int, default=-1)
    parser.add_argument("--motors", type=int, default=7)
    parser.add_argument("--json", action="store_true")  # as all programs of the tests
    given = parser.parse_args()
    is_counted = given.count < 1_000_000
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
    edition = Edition(given.edition)
    participant = DomainParticipant(given.domain)
    hands = [SIDES.index(side) for side in given.hands]
    topics = [Topic(participant, f"rt/dex3/{SIDES[hand]}/state", edition.hand) for hand in hands]
    writers = [DataWriter(participant, topic) for topic in topics]
    print('{"event": "ready"}', flush=True)
    if is_counted:  # a reader drops the samples of writers that it does not know yet: it says when it has one
        while signal.sigtimedwait({signal.SIGUSR1}, 0.02) is None:
            for hand, writer in zip(hands, writers, strict=True):
                writer.write(edition.sample(given.first, hand))
        print('{"event": "silent"}', flush=True)
        signal.sigwait({signal.SIGUSR1})
    begun = time.monotonic()
    for number in range(given.first, given.first + given.count):
        for hand, writer in zip(hands, writers, strict=True):
            writer.write(edition.sample(number, hand, missing=given.missing, losing=given.losing, motors=given.motors))
        time.sleep(max(0.0, begun + (number - given.first + 1) / given.hz - time.monotonic()))
    print('{"event": "done"}', flush=True)
    time.sleep(600)


if __name__ == "__main__":
    main()
