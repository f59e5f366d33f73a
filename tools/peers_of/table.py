"""Runs the comparisons with makers' programs, and prints a table of them: see tools/peers."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

HERE, PROJECT = Path(__file__).parent, Path(__file__).parents[2]
NOT_HAD = (2, 77)
"""Exit statuses of tools whose program cannot be had on this machine."""
SCRIPTS = {
    "ability-hand": ("ability_hand.py",),
    "anyskin": ("magnetic.py", "anyskin", "anyskin"),
    "flexitac": ("flexitac_pad.py", "flexitac"),
    "linkerbot": ("linkerhand.py", "linkerbot"),
    "linkerbot-py": ("linkerhand.py", "linkerbot-py"),
    "reskin_sensor": ("magnetic.py", "reskin_sensor", "reskin_sensor"),
    "paxini-sdk": ("paxini.py",),
    "pyrobotiqtactile": ("robotiq.py",),
    "bc_stark_sdk": ("revo2.py",),
    "bc-revo3-sdk": ("revo3.py",),
}
"""Comparisons in the environment of makers' programs."""
TESTS = {
    "pymodbus": ("tests/modbus/test_peers.py", "tests/modbus/test_beside_programs.py", "tests/modbus/test_gateway.py"),
    "mcap": ("tests/recording/test_reading.py",),
    "rosbags": ("tests/ros2/test_messages.py", "tests/recording/test_viewers.py"),
    "zenoh-ros2-sdk": ("tests/ros2/test_zenoh_ros2_sdk.py",),
}
"""Programs that the project's own tests run."""
TOOLS = {"fastdds": ("tools/fastdds", "--messages", "20"), "lerobot": ("tools/check_lerobot",)}


@dataclass
class Outcome:
    """What came of the comparisons with a program."""

    name: str
    program: str = ""
    agreed: list[str] = field(default_factory=list)
    differs: list[str] = field(default_factory=list)
    not_had: str = ""

    @property
    def words(self) -> str:
        if self.not_had:
            return f"not run: {self.not_had}"
        agreed = [f"{len(self.agreed)} agreed ({'; '.join(self.agreed)})"] if self.agreed else []
        return "; ".join([*agreed, *(f"DIFFERS: {each}" for each in self.differs)])


def run(command: Sequence[str], **environment: str) -> tuple[int, list[str]]:
    done = subprocess.run(
        command, cwd=PROJECT, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    print(done.stdout, file=sys.stderr, end="")
    if done.returncode:
        print(done.stderr, file=sys.stderr, end="")
    return done.returncode, [*done.stdout.splitlines(), *(done.stderr.splitlines() if done.returncode else ())]


def outcome(name: str, command: Sequence[str], program: str, **environment: str) -> Outcome:
    """Run one: its lines ``program: NAME VERSION``, ``agreed: WHAT`` and ``differs: WHAT``, or its status."""
    status, lines = run(command, **environment)
    made = Outcome(name, program)
    for line in lines:
        kind, _, more = line.partition(": ")
        if kind == "program":
            made.program = more
        elif kind in ("agreed", "differs"):
            getattr(made, kind).append(more)
    if made.agreed or made.differs:
        return made
    last = lines[-1] if lines else "no output"
    if status in NOT_HAD:
        made.not_had = last
    else:
        (made.differs if status else made.agreed).append(last)
    return made


def compared(name: str, peers: str) -> Outcome:
    if name in TOOLS:
        return outcome(name, TOOLS[name], {"fastdds": "Fast DDS 2.9.1"}.get(name, name))
    if name in TESTS:
        return outcome(name, (sys.executable, "-m", "pytest", "-q", *TESTS[name]), f"{name} {_version(name)}")
    script = HERE / SCRIPTS[name][0]
    if not script.exists():
        return missing(name, script)
    path = os.environ["PYTHONPATH"]
    newer = f"{Path(peers).parents[1]}/{name}"
    more = {"PYTHONPATH": f"{newer}:{path}"} if Path(newer).exists() else {}
    return outcome(name, (peers, "-W", "ignore", str(script), *SCRIPTS[name][1:]), name, **more)


def missing(name: str, script: Path) -> Outcome:
    return Outcome(name, name, not_had=f"there is no {script.relative_to(PROJECT)}")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "?"


def main() -> int:
    parser = argparse.ArgumentParser(prog="tools/peers", description=__doc__)
    parser.add_argument("peers", help=argparse.SUPPRESS)
    every = [*SCRIPTS, *TESTS, *TOOLS]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(every)}; default: all")
    parser.add_argument(
        "--yarp",
        metavar="DIR",
        action="append",
        default=[],
        help="also compare with YARP, whose sources are in DIR; repeat it",
    )
    parser.add_argument("--hours", default="0.02", metavar="H", help="how long programs of YARP run  [default: 0.02]")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--markdown", action="store_true", help="rows for pages")
    options = parser.parse_args()
    names = options.names or ([] if options.yarp else every)
    if unknown := [each for each in names if each not in every]:
        parser.error(f"{', '.join(unknown)}: give names of {', '.join(every)}")
    outcomes = [compared(each, options.peers) for each in names]
    yarp = (sys.executable, str(HERE / "yarp.py"), "--hours", options.hours)
    outcomes += [outcome("yarp", (*yarp, folder), "YARP") for folder in options.yarp]
    today = datetime.now(UTC).date().isoformat()
    for each in outcomes:
        if options.json:
            print(json.dumps({**asdict(each), "date": today}))
        elif options.markdown:
            print(f"| {each.program} | {today} | {each.words} |")
        else:
            print(f"{each.program:28} {today}  {each.words}")
    return int(any(each.differs for each in outcomes))


if __name__ == "__main__":
    sys.exit(main())
