"""What it costs to take frames from the kernel: recvmmsg, a ring of packets (TPACKET_V2, V3), io_uring multishot.

    tools/bench ways [--rounds 5]              on a pair of ethernet interfaces in a network namespace; needs root
    tools/bench ways check                     in the CAN lab: own frames, stamps, error frames, drops

The frames are those of CAN, on packet sockets, so that all ways take the same ones in turns. *Drained*: a portion of
1008 frames is sent and then taken, ns of processor time a frame for each. *Waited*: until the last frame of a portion
could be taken. *At rest*: 2560 frames/s, a rest of 5 ms after each take; processor time of the receiver, % of a core.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
WAYS = ("recvmmsg", "ring2", "ring3", "uring")
NAMESPACE = f"ways-{os.getpid()}"
SECONDS = 4
CHECK = """
modprobe -a can-raw vcan
ip link add dev vcan0 type vcan
ip link set vcan0 up
for way in raw rawuring recvmmsg ring2 ring3; do "$0" check $way vcan0; done
"""


def compile_program(folder: Path) -> Path:
    """The C program."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        sys.exit("ways: a C compiler is needed (Debian and Ubuntu: apt install gcc libc6-dev)")
    program = folder / "ways_in"
    flags = ["-std=c11", "-O2", "-Wall", "-Wextra"]
    subprocess.run([compiler, *flags, "-o", program, HERE / "ways_in.c"], check=True)
    return program


def inside(*command: str | Path) -> list[str]:
    """A command in the network namespace."""
    return ["ip", "netns", "exec", NAMESPACE, *map(str, command)]


def result_of(*command: str | Path) -> dict[str, Any]:
    """What the program prints, as JSON."""
    done = subprocess.run(inside(*command), capture_output=True, text=True, check=True, timeout=60)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def compare(program: Path, rounds: int) -> None:
    """All ways in turns."""
    drained: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
    resting: dict[str, list[float]] = {way: [] for way in WAYS}
    for _ in range(rounds):
        for way in WAYS:
            drained[way].append(result_of(program, "cost", way, "vb", "va", "1008", "300"))
            sender = subprocess.Popen(
                inside(program, "send", "va", "2560", str(SECONDS + 1)), stdout=subprocess.DEVNULL
            )
            resting[way].append(result_of(program, "rest", way, "vb", str(SECONDS), "5000")["cpu_s"] / SECONDS)
            sender.wait()
    print(f"{'':10} sent ns  drained ns  waited ms  at rest %")
    for way in WAYS:
        sent, taken, waited = (
            statistics.median(one[name] for one in drained[way]) for name in ("send_ns", "receive_ns", "wait_ms")
        )
        lost = sum(one["sent"] - one["received"] for one in drained[way])
        rest = 100 * statistics.median(resting[way])
        print(f"{way:10} {sent:7.0f} {taken:11.1f} {waited:10.2f} {rest:10.2f}{f'  LOST {lost}' if lost else ''}")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=["cost", "check"], default="cost")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        program = compile_program(Path(folder))
        if arguments.what == "check":
            lab = [sys.executable, str(HERE.parent / "can_lab"), "run", "--"]
            sys.exit(subprocess.run([*lab, "sh", "-c", CHECK, str(program)], check=False).returncode)
        if os.geteuid() != 0:
            sys.exit("ways: a network namespace and packet sockets are needed: run as root")
        subprocess.run(["ip", "netns", "add", NAMESPACE], check=True)
        try:
            add = ["ip", "-n", NAMESPACE, "link", "add", "va", "type", "veth", "peer", "name", "vb"]
            subprocess.run(add, check=True)
            for name in ("va", "vb"):
                subprocess.run(["ip", "-n", NAMESPACE, "link", "set", name, "up"], check=True)
            compare(program, arguments.rounds)
        finally:
            subprocess.run(["ip", "netns", "del", NAMESPACE], check=False)


if __name__ == "__main__":
    main()
