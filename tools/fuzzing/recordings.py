"""Recordings of every driver's emulated hardware, damaged at random: no crash, and every undamaged chunk is read.

Then the same recordings with forged contents whose checksums fit: no crash either, and no more memory than the limits
allow.

``tools/fuzz recordings [NAME ...] [--damages 1000] [--forgeries 1000] [--seed N]``. Exit status 1 if it is otherwise.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from importlib.metadata import entry_points
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from skinware import Namespace
from skinware_drivers.registry import DRIVERS
from tests.commands import running
from tests.recording.damaging import Original
from tests.recording.hostile import Forger, use

MOST_MEMORY = 6 << 30


def record(driver: str, file: Path) -> None:
    """Two seconds of a driver on the bus `virtual`, with what goes over it, and with what viewers show."""
    with running("skin-driver", "--driver", driver, "--bus", "virtual") as source:
        source.wait_for("ready")
        with running("skin-record", "--wire", "--viewers", "-o", str(file), "-T", "2") as recorder:
            recorder.wait_for("stopped")


def forge(name: str, file: Path, count: int, seed: int) -> int:
    """Read recordings with forged contents; how many of them made a reader fail."""
    forger, generator, forged = Forger(file), random.Random(seed), file.with_name("forged.mcap")
    failed = said = 0
    for number in range(count):
        forger.forge(generator, forged)
        try:
            said += bool(use(forged, file.with_name("recovered.mcap")))
        except Exception as error:  # noqa: BLE001, a crash is what is sought
            failed += 1
            kept = shutil.copy(forged, f"forged-{name}-{number}.mcap")
            print(f"{name}, forgery {number} of seed {seed}: {type(error).__name__}: {error}; {kept}")
            traceback.print_exc()
    print(f"{name}: {count} forgeries, {said} of them found to be bad, {failed} failed", flush=True)
    return failed


def main() -> None:
    ours = sorted(e.name for e in entry_points(group=DRIVERS) if e.value.startswith("skinware_drivers."))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", default=ours, help="drivers; default: all that ship")
    parser.add_argument("--damages", type=int, default=1000)
    parser.add_argument("--forgeries", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=time.time_ns())
    options = parser.parse_args()
    os.environ["SKINWARE_NAMESPACE"] = f"damage-{os.getpid()}"
    failed = 0
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    try:
        for name in options.names:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "skin.mcap"
                record(name, file)
                original, generator, read, worst = Original(file), random.Random(options.seed), 0, 1.0
                for number in range(options.damages):
                    try:
                        found = original.check(generator, Path(folder) / "damaged.mcap")
                    except Exception as error:  # noqa: BLE001, a crash is what is sought
                        failed += 1
                        kept = shutil.copy(Path(folder) / "damaged.mcap", f"damaged-{name}-{number}.mcap")
                        shutil.copy(file, f"undamaged-{name}-{number}.mcap")
                        print(
                            f"{name}, damage {number} of seed {options.seed}: {type(error).__name__}: {error}; {kept}"
                        )
                        traceback.print_exc()
                        continue
                    read += found
                    worst = min(worst, found / len(original.frames))
                failed += forge(name, file, options.forgeries, options.seed)
                share = read / max(1, options.damages * len(original.frames))
                what = f"{len(original.frames)} frames, {len(original.on_wires)} on wires"
                print(f"{name}: {what}, {100 * share:.1f} % read, at worst {100 * worst:.1f} %", flush=True)
    finally:
        shutil.rmtree(Namespace().path, ignore_errors=True)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
