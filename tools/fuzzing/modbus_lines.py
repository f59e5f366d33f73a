"""Fuzzing of Modbus: ``modbus_lines.py [--bytes 10_000_000] [--seed N]``.

Two buses hear the same from the other end of a line or connection: good replies, halves, damaged ones, exceptions,
replies to other questions and any bytes. C asks on one of them while all is well, Python alone on the other: they must
ask, count and have the same. A listener hears as many bytes of noise. The input that broke it is in
.cache/fuzz/modbus.crash, and ``--input FILE`` runs it once more.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import shutil
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CRASH = ROOT / ".cache" / "fuzz" / "modbus.crash"
LONGEST = 3000
sys.path.insert(0, str(ROOT))


def fuzz(n_bytes: int, rng: random.Random) -> None:
    """Until so many bytes were heard by each of the three."""
    from tests.modbus import fuzzing
    from tests.specification.both_paths import hand_clock

    heard = frames = runs = in_c = 0
    with hand_clock() as clock:
        while heard < n_bytes:
            data = rng.randbytes(rng.randint(1, LONGEST))
            CRASH.write_bytes(data)
            outcome = fuzzing.run(clock, data)
            fuzzing.listen(rng.randbytes(outcome.heard))
            runs, heard = runs + 1, heard + outcome.heard
            frames, in_c = frames + outcome.frames, in_c + outcome.in_c
    print(f"held: {runs} runs, {heard} bytes, {frames} frames; C had the line {in_c} times")
    CRASH.unlink()


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bytes", type=int, default=10_000_000, help="that are heard")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 1_000_000)
    parser.add_argument("--input", type=Path, metavar="FILE", help="run this input, and nothing else")
    given = parser.parse_args()
    CRASH.parent.mkdir(parents=True, exist_ok=True)
    os.environ["SKINWARE_NAMESPACE"] = f"fuzz-modbus-{os.getpid()}"
    logging.getLogger("skinware").addHandler(logging.NullHandler())
    from skinware.memory.namespace import Namespace
    from tests.modbus import fuzzing
    from tests.specification.both_paths import hand_clock

    Namespace().create()
    try:
        if given.input:
            with hand_clock() as clock:
                print(fuzzing.run(clock, given.input.read_bytes()))
        else:
            fuzz(given.bytes, random.Random(given.seed))
    except BaseException:
        print(f"BROKEN (seed {given.seed}): {CRASH}")
        raise
    finally:
        shutil.rmtree(Namespace().path, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
