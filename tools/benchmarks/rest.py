"""What a driver costs while a skin does nothing special: beside the least that a C program could do, in turns.

    tools/bench rest [--boards 4] [--buses 1] [--hz 20] [--seconds 10] [--rounds 5]

Boards of 16 triangles send two frames for each, ``--hz`` times a second, on UDP sockets of the loopback that stand in
for CAN interfaces (see can_traffic.py). The driver is the product, its event loop and ring included. The C loop
(receive_loop.c) receives the same frames with time stamps, looks up whose they are and copies their values; it pairs
nothing, publishes nothing, and rests as long as the driver may. The last line has the medians.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from can_buses import HERE, Result, run

from skinware import Namespace


def compile_program(name: str, folder: str) -> Path:
    """One of the C programs to compare with."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        sys.exit("a C compiler is needed for the loop to compare with (Debian and Ubuntu: apt install gcc)")
    program = Path(folder) / name
    subprocess.run([compiler, "-std=c11", "-O2", "-Wall", "-Wextra", "-o", program, HERE / f"{name}.c"], check=True)
    return program


def percent(result: Result) -> float:
    """Of a core."""
    return 100 * result.cpu


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boards", type=int, default=4, help="on every bus, 1 to 14")
    parser.add_argument("--buses", type=int, default=1)
    parser.add_argument("--hz", type=float, default=20.0, help="of every board")
    parser.add_argument("--latency", type=float, default=5.0, metavar="MS", help="the longest rest of both")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long each run sends")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    os.environ["SKINWARE_NAMESPACE"] = f"bench-{os.getpid()}"
    rate_hz = arguments.boards * 32 * arguments.hz
    with tempfile.TemporaryDirectory() as folder:
        loop = str(compile_program("receive_loop", folder))
        found: dict[str, list[Result]] = {"driver": [], "C loop": []}
        try:
            for _ in range(arguments.rounds):
                for name, kind in (("driver", "ours"), ("C loop", loop)):
                    result = run(
                        kind, rate_hz, arguments.seconds, False, arguments.buses, arguments.boards, arguments.latency
                    )
                    found[name].append(result)
                    print(
                        f"{name}: {result.sent:,} sent, {result.sent - result.received} lost,"
                        f" {percent(result):.2f} % of a core, {result.us_per_frame:.2f} us/frame",
                        flush=True,
                    )
        finally:
            shutil.rmtree(Namespace().path, ignore_errors=True)
    driver, c_loop = (statistics.median(map(percent, results)) for results in found.values())
    ratio = statistics.median(percent(a) / percent(b) for a, b in zip(*found.values(), strict=True))
    print(f"driver {driver:.2f} % of a core, C loop {c_loop:.2f} %, ratio {ratio:.1f}")


if __name__ == "__main__":
    main()
