"""Damaged streams of devices behind servers: ``python -m tests.streams.fuzzing [--bytes 10000000] [--seed 1]``.

What emulated devices send, with parts lost, repeated, changed and mixed with random bytes, cut anywhere, and with
questions in between, goes through the streams of these drivers' framings. The tests do the same with less.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Callable

from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.papillarray_packets import PapillArrayPackets
from skinware_drivers.serial.robotiq_tsf import RobotiqPackets
from skinware_drivers.serial.stream import PythonStream
from skinware_drivers.serial.weiss import WeissDsaDriver, WeissDsaOptions, _Matrix
from skinware_drivers.streams.dex3 import Dex3Driver, Dex3Options
from skinware_drivers.streams.icub_eth import rops
from skinware_drivers.streams.ros2 import Ros2Driver, Ros2Options
from skinware_drivers.streams.tesollo import TesolloDriver, TesolloOptions, _Hand
from skinware_drivers.streams.xela_server import XelaMessages
from skinware_drivers.streams.yarp_messages import YarpMessages
from skinware_drivers.virtual.devices.contactile import EmulatedPapillArray, EmulatedPapillArrayOptions
from skinware_drivers.virtual.devices.dds import EmulatedDex3, EmulatedDex3Options, EmulatedRos2, EmulatedRos2Options
from skinware_drivers.virtual.devices.icub_eth import EmulatedIcubEth, EmulatedIcubEthOptions
from skinware_drivers.virtual.devices.robotiq_tsf import EmulatedRobotiqTsf, EmulatedRobotiqTsfOptions
from skinware_drivers.virtual.devices.tesollo import EmulatedTesollo, EmulatedTesolloOptions
from skinware_drivers.virtual.devices.weiss import EmulatedWeissDsa, EmulatedWeissDsaOptions
from skinware_drivers.virtual.devices.weiss import dsa_message as message
from skinware_drivers.virtual.devices.xela import EmulatedXelaServer, EmulatedXelaServerOptions
from skinware_drivers.virtual.devices.yarp import EmulatedYarp, EmulatedYarpOptions
from tests.serial.spoken import Spoken

_ROWS = 64


def _tesollo() -> tuple[Framing, list[bytes]]:
    driver = TesolloDriver(TesolloOptions())
    hand = Spoken(EmulatedTesollo(EmulatedTesolloOptions(fitted=0b01011, pads=True)))
    ask = bytes.fromhex("0008010102030405")
    told = hand.answers(bytes.fromhex("000308")) + [answer for _ in range(20) for answer in hand.answers(ask, 10)]
    return driver._framing(_Hand(0x5F22, b"\1\5", 3, (0, 1, 3))), told


def _xela() -> tuple[Framing, list[bytes]]:
    server = Spoken(EmulatedXelaServer(EmulatedXelaServerOptions(sensors=(1, 2), model="uSPa46")))
    return XelaMessages(), server.answers(b"", 100)


def _yarp() -> tuple[Framing, list[bytes]]:
    port = Spoken(EmulatedYarp(EmulatedYarpOptions(length=12)))
    return YarpMessages(12, ((0, 0),)), port.answers(b"", 500)


def _icub() -> tuple[Framing, list[bytes]]:
    return rops(1), Spoken(EmulatedIcubEth(EmulatedIcubEthOptions(boards=(1, 7)))).answers(b"", 500)


def _dex3() -> tuple[Framing, list[bytes]]:
    return Dex3Driver(Dex3Options()).framing, Spoken(EmulatedDex3(EmulatedDex3Options())).answers(b"", 100)


def _ros2() -> tuple[Framing, list[bytes]]:
    driver, told = Ros2Driver(Ros2Options()), list[bytes]()
    for kind in ("array", "image", "points", "sensors"):
        told += Spoken(EmulatedRos2(EmulatedRos2Options(message=kind))).answers(b"", 500)
    for sample in driver.framing.framer().feed(b"".join(told)):
        assert sample.identifier == 0  # news
    driver._collect()
    driver._describe()
    return driver.framing, told


def _robotiq() -> tuple[Framing, list[bytes]]:
    fingertips = Spoken(EmulatedRobotiqTsf(EmulatedRobotiqTsfOptions()))
    return RobotiqPackets(), fingertips.answers(bytes.fromhex("9a00580105"), 500)


def _papillarray() -> tuple[Framing, list[bytes]]:
    controller = Spoken(EmulatedPapillArray(EmulatedPapillArrayOptions()))
    return PapillArrayPackets(), controller.answers(b"S\n", 100)


def _dsa() -> tuple[Framing, list[bytes]]:
    driver = WeissDsaDriver(WeissDsaOptions(rle_offset=5))
    driver._cells = (_Matrix(6, 14, 3.4, 3.4), _Matrix(6, 13, 3.4, 3.4))
    controller = Spoken(EmulatedWeissDsa(EmulatedWeissDsaOptions(fingers=1)))
    told = controller.answers(message(3, b"\x81\x1e\0"), 1000) + controller.answers(message(3, b"\x80\x1e\0"), 1000)
    return driver.split(), told


DEVICES: dict[str, Callable[[], tuple[Framing, list[bytes]]]] = {
    "tesollo": _tesollo,
    "xela_server": _xela,
    "yarp": _yarp,
    "icub_eth": _icub,
    "dex3": _dex3,
    "papillarray": _papillarray,
    "robotiq_tsf": _robotiq,
    "ros2": _ros2,
    "weiss_dsa": _dsa,
}


def fuzz(name: str, n_bytes: int, seed: int) -> BusCounters:
    """Damage the messages of a device until so many bytes have gone through.

    Returns:
        What was counted.

    Raises:
        AssertionError: a byte is not accounted for, or more is held back than a message can have.
    """
    framing, told = DEVICES[name]()
    rng, longest = random.Random(seed), max(map(len, told))
    counters, batch = BusCounters(), FrameBatch(_ROWS, -(-framing.maximum_body // 8) * 8)
    stream = PythonStream(framing, batch.payload_size, counters)
    while counters.framing.bytes_in < n_bytes:
        data = _damaged(told, rng)
        while data:
            size = rng.randint(1, 2 * longest)
            stream.add(data[:size], counters.framing.bytes_in)
            data = data[size:]
            while stream.is_behind:
                batch.clear()
                stream.fill(batch, 0)
            if rng.random() < 0.2:
                stream.asked()
            stream.take_damaged()
            found = counters.framing
            assert found.bytes_in == found.frame_bytes + found.idle_bytes + found.skipped_bytes + stream.pending
            assert stream.pending < 1 << 18
        if stream.is_lost:
            stream = PythonStream(framing, batch.payload_size, counters)
    return counters


def _damaged(told: list[bytes], rng: random.Random) -> bytes:
    data = bytearray(b"".join(rng.choices(told, k=rng.randint(1, 8))))
    for _ in range(rng.choice((0, 0, 1, 1, 2, 5))):
        at = rng.randrange(len(data) + 1)
        what = rng.randrange(5)
        if what == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif what == 1:
            data[at:at] = rng.randbytes(rng.randint(1, 40))
        elif what == 2:
            del data[at : at + rng.randint(1, 400)]
        elif what == 3:
            data[at:at] = data[at : at + rng.randint(1, 400)]
        else:
            data[at : at + 4] = rng.choice((b"\0\0\0\0", b"\xff\xff\xff\xff", b"\n{}\n", b'":[', b"1e99"))
    return bytes(data)


def main() -> None:
    """Fuzz all of them, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bytes", type=int, default=10_000_000, help="for each device")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for name in DEVICES:
        begun_s = time.monotonic()
        counters = fuzz(name, arguments.bytes, arguments.seed)
        took_s = time.monotonic() - begun_s
        framing = counters.framing
        print(
            f"{name:12} {framing.bytes_in} bytes in {took_s:.0f} s: {framing.frames} whole, {counters.frames} frames of"
            f" them, {framing.refused} refused, {framing.checksum_errors} wrong checksums"
        )


if __name__ == "__main__":
    main()
