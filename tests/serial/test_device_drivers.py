"""What drivers of particular serial devices must stand: flipped bits, a port that goes away, another device on it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.agni import AgniDriver
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.paxini import PaxiniDriver
from skinware_drivers.serial.weiss import WeissWtsDriver
from skinware_drivers.serial.wuji_glove import WujiGloveDriver
from skinware_drivers.testing.driving import emulated_on_a_pty
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.devices.agni import EmulatedAgni
from skinware_drivers.virtual.devices.paxini import EmulatedPaxini
from skinware_drivers.virtual.devices.weiss import EmulatedWeissWts
from skinware_drivers.virtual.devices.weiss import message as weiss_message
from skinware_drivers.virtual.devices.wuji_glove import EmulatedWujiGlove
from skinware_drivers.virtual.devices.wuji_glove import message as wuji_message
from tests.sdk.driving import Driving, driving_lines

FRAMES = [
    (WeissWtsDriver, weiss_message(0x00, bytes(range(5 + 8)))),
    (WujiGloveDriver, wuji_message(0x57, bytes(range(20)))),
    (AgniDriver, bytes.fromhex("F0 C4 00 01 07 01 03 02 02 00 30")),
]


@pytest.mark.parametrize(("driver", "frame"), FRAMES)
def test_no_flipped_bit_makes_a_frame(driver: type[SerialAdapter[Any]], frame: bytes) -> None:
    assert len(driver.framing.framer().feed(frame)) == 1
    uncovered = {9} if driver is WujiGloveDriver else set()  # of an answer: it becomes data of a wrong length
    for bit in set(range(8 * len(frame))) - uncovered:
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        framer = driver.framing.framer()
        assert len(framer.feed(bytes(damaged))) == 0
        found = framer.feed(frame + bytes(driver.framing.maximum_body + 16))
        assert len(found) == 1  # the next one is found


HAND = {"board": "high_speed", "slots": (2, 6, 20), "points": 9}
DEVICES: list[tuple[type[SerialAdapter[Any]], Any, dict[str, Any], dict[str, Any], tuple[int, int]]] = [
    (WeissWtsDriver, EmulatedWeissWts, {}, {"columns": 2}, (32, 16)),
    (WujiGloveDriver, EmulatedWujiGlove, {}, {}, (768, 768)),
    (AgniDriver, EmulatedAgni, {}, {"sensors": (3, 4, 5)}, (20, 12)),
    (PaxiniDriver, EmulatedPaxini, {}, {"sensor_version": "PAXINI PXSR-STDIP03B-v1.0.5", "points": 25}, (96, 78)),
    (PaxiniDriver, EmulatedPaxini, HAND, {**HAND, "slots": (6,)}, (90, 30)),
]


@contextmanager
def plugged_in(link: Path, emulator: Any, options: dict[str, Any]) -> Iterator[None]:
    with emulated_on_a_pty(emulator, **options) as path:
        link.symlink_to(path)
        try:
            yield
        finally:
            link.unlink()


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "emulator", "first", "second", "sensors"), DEVICES)
def test_it_is_unplugged_and_comes_back_as_another(
    kind: type[SerialAdapter[Any]],
    emulator: Any,
    first: dict[str, Any],
    second: dict[str, Any],
    sensors: tuple[int, int],
    tmp_path: Path,
) -> None:
    link = tmp_path / "port"
    driver = kind(kind.Options())
    bus = SerialBus(str(link), payload_size=driver.payload_size)

    def is_live(running: Driving, count: int) -> bool:
        generation = running.runner and running.runner.builder.generation
        if not generation or generation.tables.structure.n_sensors != count:
            return False
        return bool(running.status()["patches"][0]["state"] == "live")

    with ExitStack() as before:
        before.enter_context(plugged_in(link, emulator, first))
        with driving_lines([(driver, bus)], "device", wait=False) as running:
            wait_until(lambda: is_live(running, sensors[0]))
            before.close()
            wait_until(lambda: running.status()["buses"][0]["state"] in ("down", "gone", "connecting"))
            with plugged_in(link, emulator, second):
                wait_until(lambda: is_live(running, sensors[1]))
