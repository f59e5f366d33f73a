"""How far one bridge, and a fleet of them, goes: ages, rates, losses, processor time, memory.

tools/bench scale [sizes|robots|chain] [--sensors N ...] [--robots N ...] [--mode push pull] [--link fast slow]
                  [--seconds S] [--hz F] [--robot-hz F] [--robot-sensors N] [--slow-mbit M] [--loopback] [--json]

sizes   skin-bridge serve and join, as people start them, for skins of different sizes. Ages are from the driver's stamp
        to a reader behind the link, losses those of that reader.
robots  many robots at one desk, over one link: ten of them to a process, and ten of the desk's joiners. Ages are from a
        robot's publication to the arrival at the desk; lost is what was published and had not arrived in the end.
chain   one large skin through all there is: structure, writer, readers, commands, bridge, recording.

Robots are light: drivers that write frames made beforehand. Both ends are on machines of their own (network
namespaces, veth, tbf), or, where these cannot be made, on the loopback, with a proxy as the slow link. With ``--json``
each row is a line. A row that does not work says why, and the next one begins; exit status 1 then.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass

import numpy as np
import scale_chain
from bridge import read_all
from light import Account, Robot, be_desk, be_robots, drive
from links import (
    LOOPBACK,
    PATIENCE_S,
    Command,
    connect,
    descriptors,
    free_ports,
    machine,
    memory_mb,
    proxy,
    sent_bytes,
    why_no_machines,
)
from processes import Processes, RunFailed, answer, own_namespace, within

SIZES = (768, 5_376, 30_848, 100_000, 300_000)
FLEETS = (1, 3, 10, 30, 100)
TABLES = ("sizes", "robots", "chain")
TO_A_PROCESS = 10
SETTLING_S = 2.0
START_S = 90.0
"""How long a row may take beside its measurement."""


@dataclass(frozen=True)
class Setting:
    """What a row measures.

    Attributes:
        sensors: of each robot.
        robots: that one desk joins.
        hz: at which each publishes.
        mode: ``push`` or ``pull``.
        mbit: of the link, each way; None: a fast one.
        loopback: there are no machines to be made.
        seconds: of the measurement.
    """

    sensors: int
    robots: int
    hz: float
    mode: str
    mbit: float | None
    loopback: bool
    seconds: float

    @property
    def link(self) -> str:
        """For people."""
        kind = ("proxy" if self.mbit else "loopback") if self.loopback else "veth"
        return f"{kind} {self.mbit:g} Mbit/s" if self.mbit else kind


@dataclass(frozen=True)
class Row:
    """What came of it; where there are several robots, of all together.

    Attributes:
        driver_hz: frames that each robot published.
        arrived_hz: frames that arrived of each.
        lost: that did not, or not yet.
        age_p50_ms, age_p99_ms: of those that arrived.
        serve_share, join_share: of a core.
        serve_us, join_us: processor time for a frame that was published, or that arrived.
        kb: of a frame as a message.
        wire_kb: of a frame on the wire, with all headers, and clock and questions; None on the loopback.
        serve_mb, join_mb: memory of the processes, without shared memory.
        files: descriptors that the joining side has open, for each robot.
        first_s: from the start of the joining side to the first frame of each robot.
        load: of the machine, before.
    """

    driver_hz: float
    arrived_hz: float
    lost: int
    age_p50_ms: float
    age_p99_ms: float
    serve_share: float
    join_share: float
    serve_us: float
    join_us: float
    kb: float
    wire_kb: float | None
    serve_mb: float
    join_mb: float
    files: float
    first_s: float
    load: float


@contextmanager
def _ends(setting: Setting) -> Iterator[tuple[str | None, str | None, str]]:
    """Machines of the robots and of the desk, and the address of the first."""
    if setting.loopback:
        yield None, None, LOOPBACK
        return
    with machine("robots") as robots, machine("desk") as desk:
        yield robots, desk, connect(robots, desk, 1, setting.mbit)


@contextmanager
def _reached(setting: Setting, processes: Processes, ports: list[int]) -> Iterator[list[int]]:
    """Ports by which these are reached; on a slow loopback all robots share the rate evenly."""
    if not setting.loopback or setting.mbit is None:
        yield ports
        return
    pipe = processes.start(proxy, ports, setting.mbit * 1e6 / setting.robots)
    try:
        yield answer(pipe, PATIENCE_S)
    finally:
        pipe.send("enough")


def one_bridge(setting: Setting) -> Row:
    """A skin of some size, with the commands."""
    load, limit_s = os.getloadavg()[0], START_S + setting.seconds
    with within(limit_s), ExitStack() as stack:
        there, here = (stack.enter_context(own_namespace(role)).name for role in ("there", "here"))
        place, desk, host = stack.enter_context(_ends(setting))
        processes = stack.enter_context(Processes())
        driver = processes.start(drive, there, setting.sensors, setting.hz)
        answer(driver, PATIENCE_S)
        (port,) = free_ports(1)
        serve = ("serve", "--robot", "bench", "--namespace", there, "--insecure", "--listen", f"tcp/{host}:{port}")
        serving = stack.enter_context(Command(*serve, place=place))
        (reached,) = stack.enter_context(_reached(setting, processes, [port]))
        start_s = time.monotonic()
        join = ("join", "bench", "--connect", f"tcp/{host}:{reached}", "--into", here, "--mode", setting.mode)
        joining = stack.enter_context(Command(*join, place=desk))
        beyond = processes.start(read_all, here)
        answer(beyond, limit_s)
        first_s = time.monotonic() - start_s
        beside = processes.start(read_all, there)
        answer(beside, PATIENCE_S)
        time.sleep(min(SETTLING_S, setting.seconds))
        for command in (serving, joining):
            command.begin()
        sent = sent_bytes(place, 1) if place else 0
        for pipe in (beyond, beside):
            pipe.send("go")
        time.sleep(setting.seconds)
        shares = [command.share() for command in (serving, joining)]
        sent = sent_bytes(place, 1) - sent if place else 0
        weights = [memory_mb(command.pid) for command in (serving, joining)]
        files = descriptors(joining.pid)
        for pipe in (beyond, beside):
            pipe.send("enough")
        frames, lost, ages = answer(beyond, PATIENCE_S)
        taken, missed, _ = answer(beside, PATIENCE_S)
        statuses = [event for event in joining.end() if event["event"] == "status"]
        driver.send("enough")
    seconds = [service for status in statuses for service in status["services"].values()]
    told = Account(sum(second["rate_hz"] for second in seconds), bytes=sum(second["bytes_per_s"] for second in seconds))
    came = Account(frames, lost, round(frames * told.bytes / max(1, told.frames)), ages)
    return _row(setting, taken + missed, came, shares, weights, files, first_s, load, sent)


def many_robots(setting: Setting) -> Row:
    """A fleet at one desk."""
    load, limit_s = os.getloadavg()[0], START_S + setting.seconds + setting.robots
    with within(limit_s), ExitStack() as stack:
        there, here = ([_of_fleet(stack, role, n) for n in range(setting.robots)] for role in ("there", "here"))
        place, desk, host = stack.enter_context(_ends(setting))
        processes = stack.enter_context(Processes())
        ports = free_ports(setting.robots)
        reached = stack.enter_context(_reached(setting, processes, ports))
        robots = [
            Robot(f"robot{n}", there[n], here[n], f"tcp/{host}:{ports[n]}", f"tcp/{host}:{reached[n]}")
            for n in range(setting.robots)
        ]
        portions = [robots[first : first + TO_A_PROCESS] for first in range(0, setting.robots, TO_A_PROCESS)]
        serving = [processes.start(be_robots, place, part, setting.sensors, setting.hz) for part in portions]
        for pipe in serving:
            answer(pipe, limit_s)
        start_s = time.monotonic()
        joining = [processes.start(be_desk, desk, part, setting.mode) for part in portions]
        for pipe in joining:
            answer(pipe, limit_s)
        first_s = time.monotonic() - start_s
        time.sleep(min(SETTLING_S, setting.seconds))
        sent = sent_bytes(place, 1) if place else 0
        for pipe in (*serving, *joining):
            pipe.send("go")
        time.sleep(setting.seconds)
        for pipe in (*serving, *joining):
            pipe.send("enough")
        sent = sent_bytes(place, 1) - sent if place else 0
        sides = Account(), Account()
        for side, pipes in zip(sides, (serving, joining), strict=True):
            for pipe in pipes:
                side.add(answer(pipe, PATIENCE_S))
        for pipe in serving:
            pipe.send("end")
    served, joined = sides
    joined.lost = max(0, served.frames - joined.frames)
    shares = [side.cpu_s / setting.seconds for side in sides]
    weights = [side.memory_mb for side in sides]
    return _row(setting, served.frames, joined, shares, weights, joined.descriptors, first_s, load, sent)


def _of_fleet(stack: ExitStack, role: str, number: int) -> str:
    return stack.enter_context(own_namespace(f"{role}{number}")).name


def _row(
    setting: Setting,
    published: int,
    came: Account,
    shares: list[float],
    weights: list[float],
    files: int,
    first_s: float,
    load: float,
    sent: int,
) -> Row:
    if not came.frames:
        raise RunFailed("no frame came")
    p50, p99 = (float(np.percentile(came.ages_ns, share)) / 1e6 for share in (50, 99))
    of_each = setting.seconds * setting.robots
    return Row(
        driver_hz=published / of_each,
        arrived_hz=came.frames / of_each,
        lost=came.lost,
        age_p50_ms=p50,
        age_p99_ms=p99,
        serve_share=shares[0],
        join_share=shares[1],
        serve_us=1e6 * shares[0] * setting.seconds / published,
        join_us=1e6 * shares[1] * setting.seconds / came.frames,
        kb=came.bytes / came.frames / 1e3,
        wire_kb=sent / came.frames / 1e3 if sent else None,
        serve_mb=weights[0],
        join_mb=weights[1],
        files=files / setting.robots,
        first_s=first_s,
        load=load,
    )


HEAD = (
    "| sensors | robots | link | mode | Hz | arrived Hz | lost | age p50, p99 ms | serve, join % of a core |"
    " serve, join µs a frame | kB a frame, on the wire | serve, join MB | first frame s |"
)


def told(setting: Setting, row: Row | str) -> str:
    """A line of the table, with what was measured, or why it was not."""
    begin = f"| {setting.sensors:,} | {setting.robots} | {setting.link} | {setting.mode} |"
    if isinstance(row, str):
        return f"{begin} {row} |"
    wire = "" if row.wire_kb is None else f", {row.wire_kb:.2f}"
    cells = (
        f"{row.driver_hz:.1f}",
        f"{row.arrived_hz:.1f}",
        row.lost,
        f"{row.age_p50_ms:.2f}, {row.age_p99_ms:.2f}",
        f"{100 * row.serve_share:.1f}, {100 * row.join_share:.1f}",
        f"{row.serve_us:.0f}, {row.join_us:.0f}",
        f"{row.kb:.2f}{wire}",
        f"{row.serve_mb:.0f}, {row.join_mb:.0f}",
        f"{row.first_s:.1f}",
    )
    return f"{begin} {' | '.join(map(str, cells))} |"


def costs(rows: list[tuple[Setting, Row]]) -> dict[str, dict[str, float]]:
    """Processor time of a pushed frame as microseconds plus so many a kB, by a line through the fast rows of sizes."""
    seen = [row for setting, row in rows if setting.mode == "push" and setting.mbit is None]
    if len({row.kb for row in seen}) < 2:
        return {}
    lines = {}
    for end in ("serve", "join"):
        took = np.array([getattr(row, f"{end}_us") for row in seen])
        a_kb, a_frame = np.polyfit([row.kb for row in seen], took, 1, w=1 / took)
        lines[end] = {"us_a_frame": float(a_frame), "us_a_kb": float(a_kb)}
    return lines


def settings(options: argparse.Namespace, what: str) -> list[Setting]:
    """The rows of a table."""
    sizes = [(sensors, 1, options.hz) for sensors in options.sensors]
    fleets = [(options.robot_sensors, robots, options.robot_hz) for robots in options.robots]
    links = [None if link == "fast" else options.slow_mbit for link in options.link]
    return [
        Setting(sensors, robots, hz, mode, mbit, options.loopback, options.seconds)
        for (sensors, robots, hz), mbit, mode in itertools.product(
            sizes if what == "sizes" else fleets, links, options.mode
        )
    ]


def table(options: argparse.Namespace, what: str) -> bool:
    """Measure and tell the rows of a table; whether all went well."""
    rows, well = [], True
    if not options.json:
        print(f"{what}: {options.seconds:g} s each\n{HEAD}\n|{'---|' * (HEAD.count('|') - 1)}")
    for setting in settings(options, what):
        try:
            row = (one_bridge if what == "sizes" else many_robots)(setting)
        except (RunFailed, OSError) as error:
            well = False
            why = str(error).strip().splitlines()[-1]
            failed = {"table": what, **asdict(setting), "link": setting.link, "failed": why}
            print(json.dumps(failed) if options.json else told(setting, why), flush=True)
            continue
        rows.append((setting, row))
        measured = {"table": what, **asdict(setting), "link": setting.link, **asdict(row)}
        print(json.dumps(measured) if options.json else told(setting, row), flush=True)
    lines = costs(rows) if what == "sizes" else {}
    if options.json and lines:
        print(json.dumps({"table": "costs", **lines}))
    for end, line in lines.items() if not options.json else ():
        print(f"{end}: {line['us_a_frame']:.0f} µs a frame and {line['us_a_kb']:.2f} µs a kB")
    return well


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=TABLES)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--sensors", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--hz", type=float, default=50, help="of the skins of sizes")
    parser.add_argument("--robots", type=int, nargs="+", default=list(FLEETS))
    parser.add_argument("--robot-sensors", type=int, default=768, help="of each robot of a fleet")
    parser.add_argument("--robot-hz", type=float, default=20, help="of each robot of a fleet")
    parser.add_argument("--mode", nargs="+", choices=["push", "pull"], default=["push", "pull"])
    parser.add_argument("--link", nargs="+", choices=["fast", "slow"], default=["fast", "slow"])
    parser.add_argument("--slow-mbit", type=float, default=16)
    parser.add_argument("--loopback", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # and nothing is left behind
    if not options.loopback and (why := why_no_machines()):
        print(f"no links between machines ({why}): all on the loopback", file=sys.stderr)
        options.loopback = True
    well = True
    for what in (options.what,) if options.what else TABLES:
        if what == "chain":
            well &= scale_chain.tell(max(options.sensors), options.hz, options.seconds, options.json)
        else:
            well &= table(options, what)
    sys.exit(0 if well else 1)


if __name__ == "__main__":
    main()
