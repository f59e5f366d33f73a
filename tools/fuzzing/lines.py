"""Fuzzing of whole drivers of serial devices: ``tools/fuzz lines DRIVER ... [--bytes 10000000] [--seed N]``.

What the driver's emulated device says, to the driver's own questions, is damaged in every way that a line knows: bytes
flipped, lost, repeated, inserted, frames cut and joined, noise. It goes through both ways of finding frames, and what
these find through both data paths. Nothing may be raised, no byte may be missing in the counters, both ways and both
paths must do the same, and when good bytes come again, they are shown.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))


from skinware.memory.namespace import Namespace  # noqa: E402
from skinware_drivers.bus import FrameBatch  # noqa: E402
from skinware_drivers.counters import BusCounters  # noqa: E402
from skinware_drivers.description import SkinTables  # noqa: E402
from skinware_drivers.registry import load_driver  # noqa: E402
from skinware_drivers.serial.adapter import SerialAdapter  # noqa: E402
from skinware_drivers.testing.comparison import until_fresh  # noqa: E402
from skinware_drivers.testing.rig import Suite, play  # noqa: E402
from skinware_drivers.virtual.hand_clock import HandClock  # noqa: E402
from skinware_drivers.virtual.hardware import load_emulator  # noqa: E402
from tests.specification.both_paths import Pair, hand_clock  # noqa: E402
from tests.specification.one_path import Publishing  # noqa: E402
from tests.specification.path_tests import made  # noqa: E402

_HEARD_S = 2.0
_PIECE, _MOST_DAMAGES = 30_000, 40
_ROWS = 256
_NAMESPACE = Namespace(f"fuzz-lines-{os.getpid()}")


def heard(name: str, emulated: dict[str, Any], options: dict[str, Any]) -> tuple[SerialAdapter[Any], SkinTables, bytes]:
    """A driver that has described its emulated device, its skin, and what came over the line."""

    class Heard(Suite):
        driver = load_driver(name)
        emulator = load_emulator(name)
        driver_options = options
        emulator_options = emulated

    async def scenario(clock: HandClock) -> tuple[SerialAdapter[Any], SkinTables, bytes]:
        async with Heard().running(clock) as rig:
            await until_fresh(rig)
            said: list[bytes] = []
            emit = rig.devices.emit

            def listen(now_ns: int) -> Any:
                frames = emit(now_ns)
                said.extend(frame.payload for frame in frames)
                return frames

            rig.devices.emit = listen
            await rig.sleep(_HEARD_S)
            assert rig.runner is not None
            assert rig.runner.builder.generation is not None
            assert isinstance(rig.adapter, SerialAdapter)
            return rig.adapter, rig.runner.builder.generation.tables, b"".join(said)

    return play(scenario)


def damaged(good: bytes, rng: random.Random) -> bytes:
    """A piece of it, with something wrong."""
    at = rng.randrange(len(good))
    piece = bytearray(good[at : at + rng.randint(1, _PIECE)])
    for _ in range(rng.randrange(_MOST_DAMAGES)):
        here, what = rng.randint(0, len(piece)), rng.randrange(6)
        if what == 0 and piece:
            piece[here % len(piece)] ^= 1 << rng.randrange(8)
        elif what == 1:
            del piece[here : here + rng.randint(1, 400)]
        elif what == 2:
            piece[here:here] = rng.randbytes(rng.randint(1, 60))
        elif what == 3:
            piece[here:here] = piece[here : here + rng.randint(1, 400)]
        elif what == 4:
            piece[here:here] = good[: rng.randint(1, 4)] * rng.randint(1, 20)
        elif here > len(piece) // 2:
            del piece[here:]
    return bytes(piece)


def fuzz(name: str, total: int, rng: random.Random, emulated: dict[str, Any], options: dict[str, Any]) -> str:
    """So many bytes; what came of it, in words."""
    adapter, tables, good = heard(name, emulated, options)
    counters, size = BusCounters(), adapter.payload_size
    stream = made(adapter.framing, size, counters)
    batch = FrameBatch(_ROWS, size)
    fed = 0
    with hand_clock() as clock:
        publishing = Publishing(adapter.period_s, adapter.by_cycle)
        more: dict[str, Any] = {"rows": _ROWS, "payload_size": size, "namespace": _NAMESPACE}
        with Pair(clock, [adapter.layout], tables, [adapter.period_s], publishing, **more) as pair:

            def feed(chunk: bytes) -> None:
                stream.add(chunk, clock.now_ns)
                while True:
                    batch.clear()
                    stream.fill(batch, 0)
                    stream.take_damaged()
                    pair.feed_rows(batch.wire[: batch.stop], batch.time_ns[: batch.stop])
                    if not stream.is_behind:
                        break
                pair.pass_to(clock.now_ns + rng.randrange(20_000_000))
                framing = counters.framing
                told = framing.frame_bytes + framing.idle_bytes + framing.skipped_bytes + stream.pending
                assert framing.bytes_in == told, counters

            while fed < total:
                chunk = damaged(good, rng)
                feed(chunk)
                fed += len(chunk)
            before = pair.numpy.decoder.state.patch_counters.sum()
            for at in range(0, len(good), _PIECE):
                feed(good[at : at + _PIECE])
            assert pair.numpy.decoder.state.patch_counters.sum() > before, "good bytes are shown no more"
            frames = pair.frames
    counts = counters.framing
    return (
        f"{name}: {fed:,} bytes held: {counts.frames:,} frames found, {counts.skipped_bytes:,} bytes skipped,"
        f" {frames:,} frames published"
    )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="DRIVER", help="perhaps with options: NAME:key=value,...")
    parser.add_argument("--bytes", type=int, default=10_000_000, help="of each")
    parser.add_argument("--seed", type=int, metavar="N", help="the same bytes each time")
    arguments = parser.parse_args()
    seed = time.time_ns() if arguments.seed is None else arguments.seed
    try:
        for told in arguments.names:
            name, _, options = told.partition(":")
            given: dict[str, Any] = dict(pair.split("=") for pair in options.split(",") if pair)
            known: Any = load_emulator(name)
            of_device = {key: text for key, text in given.items() if key in known.Options.__struct_fields__}
            of_driver = {key: text for key, text in given.items() if key in load_driver(name).Options.__struct_fields__}
            held = fuzz(name, arguments.bytes, random.Random(seed), of_device, of_driver)
            print(f"seed {seed}: {held}", flush=True)
    finally:
        shutil.rmtree(_NAMESPACE.path, ignore_errors=True)


if __name__ == "__main__":
    main()
