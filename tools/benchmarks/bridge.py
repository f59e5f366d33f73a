"""A bridge between two network namespaces: ages, rates, losses and processor time, on a fast link and on a slow one.

tools/bench bridge [--seconds S] [--sensors N ...] [--slow-mbit M] [--loopback]

A driver publishes at 100 Hz on one side. A reader beside it, and one on the other side, take every frame; ages are from
the driver's stamp to the reader, both of one clock. With a slow link there is a second receiver on a fast one, which
must not notice. Where network namespaces cannot be made (not root), ``--loopback``: the fast link only.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from processes import Processes, answer, own_namespace
from record import LARGE, RATE_HZ, SMALL, driving

from skinware.errors import Overrun, ServiceTimeout, StructureChanged
from skinware.realtime import now_ns
from skinware.service import ServiceReader

BIN = Path(sys.executable).parent
PORT = 7461
PATIENCE_S = 30.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def read_all(pipe: Connection, namespace: str) -> None:
    """Take every frame from when the other end says so, until it says enough; (frames, lost, ages in ns) then."""
    ages: list[int] = []
    with ServiceReader("large", namespace=namespace, timeout_s=PATIENCE_S) as reader:
        pipe.send("ready")
        answer(pipe, PATIENCE_S)
        reader.read()
        lost = reader.lost
        frames = reader.in_order(timeout_s=0.5)
        while not pipe.poll():
            try:
                frame = next(frames)
            except (ServiceTimeout, Overrun):
                frames = reader.in_order(timeout_s=0.5)
                continue
            except StructureChanged:
                reader.reattach()
                frames = reader.in_order(timeout_s=0.5)
                continue
            ages.append(now_ns() - frame.acquired_ns)
        pipe.send((len(ages), reader.lost - lost, ages))


class Command:
    """One of our commands, with what it says."""

    def __init__(self, *arguments: str, where: str | None = None) -> None:
        inside = ["ip", "netns", "exec", where] if where else []
        self._process = subprocess.Popen(
            [*inside, str(BIN / "skin-bridge"), *arguments, "--json"], stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        assert json.loads(self._process.stdout.readline())["event"] == "ready"
        self._begin = self._cpu_s(), time.monotonic()

    def begin(self) -> None:
        """Count processor time from now on."""
        self._begin = self._cpu_s(), time.monotonic()

    def share(self) -> float:
        """Of a core, since ``begin``."""
        cpu_s, begin_s = self._begin
        return (self._cpu_s() - cpu_s) / (time.monotonic() - begin_s)

    def end(self) -> list[dict[str, Any]]:
        """Its events."""
        self._process.send_signal(signal.SIGINT)
        out, _ = self._process.communicate(timeout=PATIENCE_S)
        return [json.loads(line) for line in out.splitlines()]

    def _cpu_s(self) -> float:
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def run(*command: str) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


@contextmanager
def side(name: str, number: int, mbit: float | None) -> Iterator[tuple[str, str]]:
    """A network namespace behind a link of its own; (its name, address of this side)."""
    here, there, net = f"skb{number}a", f"skb{number}b", f"10.77.{number}"
    run("ip", "netns", "add", name)
    try:
        run("ip", "link", "add", here, "type", "veth", "peer", "name", there, "netns", name)
        run("ip", "addr", "add", f"{net}.1/24", "dev", here)
        run("ip", "link", "set", here, "up")
        run("ip", "-n", name, "addr", "add", f"{net}.2/24", "dev", there)
        run("ip", "-n", name, "link", "set", there, "up")
        run("ip", "-n", name, "link", "set", "lo", "up")
        if mbit is not None:
            shape = ("tbf", "rate", f"{mbit:g}mbit", "burst", "32kb", "latency", "50ms")
            run("tc", "qdisc", "add", "dev", here, "root", *shape)
            run("ip", "netns", "exec", name, "tc", "qdisc", "add", "dev", there, "root", *shape)
        yield name, f"{net}.1"
    finally:
        with contextlib.suppress(subprocess.CalledProcessError):
            run("ip", "link", "del", here)
        run("ip", "netns", "del", name)


def told(what: str, result: tuple[int, int, list[int]], seconds: float, beside: float | None = None) -> None:
    frames, lost, ages = result
    p50, p99 = (float(np.percentile(ages, share)) / 1e6 for share in (50, 99)) if ages else (np.nan, np.nan)
    above = "" if beside is None else f", {p50 - beside:+.2f} ms of the reader beside the driver"
    print(
        f"    {what:<28} {frames / seconds:6.1f} Hz  {lost:6} lost  age p50 {p50:7.2f} ms, p99 {p99:7.2f} ms{above}",
        flush=True,
    )


def measure(sensors: int, seconds: float, mbit: float | None, loopback: bool) -> None:
    print(f"  {sensors} sensors at {RATE_HZ} Hz, {seconds:g} s, load {os.getloadavg()[0]:.1f}")
    with ExitStack() as stack:
        namespace = stack.enter_context(own_namespace())
        stack.enter_context(driving(namespace.name, sensors, "analogue"))
        receivers: dict[str, tuple[str | None, str]] = {"fast": (None, "127.0.0.1")} if loopback else {}
        if not loopback:
            receivers["fast"] = stack.enter_context(side("skin-fast", 1, None))
            if mbit is not None:
                receivers["slow"] = stack.enter_context(side("skin-slow", 2, mbit))
        listen = [part for _, host in receivers.values() for part in ("--listen", f"tcp/{host}:{PORT}")]
        serving = Command("serve", "--robot", "bench", "--namespace", namespace.name, "--insecure", *listen)
        joins, places = {}, {}
        for name, (where, host) in receivers.items():
            places[name] = f"{namespace.name}-{name}"
            joins[name] = Command(
                "join", "bench", "--connect", f"tcp/{host}:{PORT}", "--into", places[name], where=where
            )
        processes = stack.enter_context(Processes())
        readers = {"beside the driver": processes.start(read_all, namespace.name)}
        readers |= {f"{name} link": processes.start(read_all, place) for name, place in places.items()}
        for pipe in readers.values():
            answer(pipe, PATIENCE_S)
        time.sleep(8 if mbit else 3)  # the clocks, and the mode of the slow one
        for command in (serving, *joins.values()):
            command.begin()
        for pipe in readers.values():
            pipe.send("go")
        time.sleep(seconds)
        shares = {name: command.share() for name, command in {"serve": serving, **joins}.items()}
        for pipe in readers.values():
            pipe.send("enough")
        results = {name: answer(pipe, PATIENCE_S) for name, pipe in readers.items()}
        events = {name: command.end() for name, command in {"serve": serving, **joins}.items()}
    local = float(np.percentile(results["beside the driver"][2], 50)) / 1e6
    for name, result in results.items():
        told(name, result, seconds, None if name == "beside the driver" else local)
    for name, share in shares.items():
        last = [event for event in events[name] if event["event"] == "status"][-1]
        more = ""
        if name != "serve":
            service = last["services"]["large"]
            clock = last["clock"]  # both ends have the same one
            wrong = f"clock wrong by {abs(clock['offset_ms']):.3f} ms, told {clock['error_ms']:.3f}"
            more = f", {service['mode']}, {service['bytes_per_s'] / 1e6:.2f} MB/s, {wrong}"
        print(f"    {name:<6} {100 * share:5.1f} % of a core{more}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--sensors", type=int, nargs="+", default=[SMALL, LARGE])
    parser.add_argument("--slow-mbit", type=float, default=16)
    parser.add_argument("--loopback", action="store_true")
    options = parser.parse_args()
    for sensors in options.sensors:
        print("fast link")
        measure(sensors, options.seconds, None, options.loopback)
        if not options.loopback:
            print(f"a fast link, and one of {options.slow_mbit:g} Mbit/s")
            measure(sensors, options.seconds, options.slow_mbit, False)


if __name__ == "__main__":
    main()
