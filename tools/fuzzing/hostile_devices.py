"""Hostile devices for drivers of Modbus: ``tools/fuzz hostile_devices [NAME ...] [--bytes 10000000] [--seed N]``."""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from skinware.memory.namespace import Namespace


def main() -> None:
    """Entry point."""
    from tests.modbus.hostile import FUZZED, fuzz

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FUZZED)}; default: all")
    parser.add_argument("--bytes", type=int, default=10_000_000, help="for each of them, half of it over TCP")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 1_000_000)
    arguments = parser.parse_args()
    if unknown := sorted(set(arguments.names) - set(FUZZED)):
        parser.error(f"no driver {', '.join(unknown)}; there are: {', '.join(FUZZED)}")
    logging.getLogger("skinware").addHandler(logging.NullHandler())
    os.environ["SKINWARE_NAMESPACE"] = f"fuzz-{os.getpid()}"
    try:
        for name in arguments.names or FUZZED:
            for over_tcp in (False, True):
                found = fuzz(FUZZED[name](), arguments.bytes // 2, arguments.seed, over_tcp=over_tcp)
                way = "TCP" if over_tcp else "RTU"
                figures = ", ".join(f"{count} {what}" for what, count in sorted(found.items()))
                print(f"{name:20} {way} held (seed {arguments.seed}): {figures}", flush=True)
    finally:
        shutil.rmtree(Namespace().path, ignore_errors=True)


if __name__ == "__main__":
    main()
