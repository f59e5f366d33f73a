"""Random frames through the layouts of drivers whose hardware numbers no frames, in numpy and in C.

``tools/fuzz frames [NAME ...] [--bytes 10000000] [--seed N]``: so many bytes of payloads for each. Exit status 1 if
anything raises, or if the two do not do the same.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.drivers.frame_fuzzing import fuzz
from tests.drivers.fuzzed import FUZZED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", default=sorted(FUZZED), help=f"{', '.join(FUZZED)}")
    parser.add_argument("--bytes", type=int, default=10_000_000, dest="n_bytes")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 1_000_000)
    options = parser.parse_args()
    for name in options.names:
        outcome = fuzz(FUZZED[name](), options.n_bytes, options.seed)
        print(
            f"{name}: held, seed {options.seed}: {outcome.fed} bytes, {outcome.updates} updates,"
            f" {outcome.counted} frames counted as wrong"
        )


main()
