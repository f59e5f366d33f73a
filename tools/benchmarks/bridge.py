"""A bridge between two network namespaces: ages, rates, losses and processor time, on a fast link and on a slow one.

tools/bench bridge [--seconds S] [--sensors N ...] [--slow-mbit M] [--loopback]
tools/bench bridge [--seconds S] [--sensors N ...] --far MS ... [--jitter MS] [--loss SHARE] [--tcp bbr]

A driver publishes at 100 Hz on one side. A reader beside it, and one on the other side, take every frame; ages are from
the driver's stamp to the reader, both of one clock. With a slow link there is a second receiver on a fast one, which
must not notice. ``--far`` measures links with delay instead, with ``--jitter``, ``--loss`` and another ``--tcp``. Where
network namespaces cannot be made (not root), ``--loopback``: the fast link only.
"""

from __future__ import annotations

import argparse
import os
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection

import numpy as np
from links import LOOPBACK, PATIENCE_S, Command, connect, machine
from long_links import Far, long_link
from processes import Processes, answer, own_namespace
from record import LARGE, RATE_HZ, SMALL, driving

from skinware.errors import Overrun, ServiceTimeout, StructureChanged
from skinware.realtime import now_ns
from skinware.service import ServiceReader

PORT = 7461


def read_all(pipe: Connection, namespace: str) -> None:
    """Take every frame from when the other end says so, until it says enough; (frames, lost, ages in ns) then."""
    ages: list[int] = []
    with ServiceReader("large", namespace=namespace, timeout_s=PATIENCE_S) as reader:
        pipe.send("ready")
        answer(pipe, PATIENCE_S)
        reader.read()
        lost = reader.missed
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
        pipe.send((len(ages), reader.missed - lost, ages))


def told(what: str, result: tuple[int, int, list[int]], seconds: float, beside: float | None = None) -> None:
    frames, lost, ages = result
    p50, p99 = (float(np.percentile(ages, share)) / 1e6 for share in (50, 99)) if ages else (np.nan, np.nan)
    above = "" if beside is None else f", {p50 - beside:+.2f} ms of the reader beside the driver"
    print(
        f"    {what:<28} {frames / seconds:6.1f} Hz  {lost:6} lost  age p50 {p50:7.2f} ms, p99 {p99:7.2f} ms{above}",
        flush=True,
    )


def measure(sensors: int, seconds: float, mbit: float | None, loopback: bool, far: Far | None = None) -> None:
    print(f"  {sensors} sensors at {RATE_HZ} Hz, {seconds:g} s, load {os.getloadavg()[0]:.1f}")
    with ExitStack() as stack:
        namespace = stack.enter_context(own_namespace())
        stack.enter_context(driving(namespace.name, sensors, "analogue"))
        receivers: dict[str, tuple[str | None, str]] = {"fast": (None, LOOPBACK)}
        robot = None if loopback else stack.enter_context(machine("robot"))
        if far is not None and robot is not None:
            there = stack.enter_context(machine("far"))
            receivers = {"far": (there, stack.enter_context(long_link(robot, there, 1, far)))}
        elif robot is not None:
            for number, name in enumerate(("fast",) if mbit is None else ("fast", "slow"), 1):
                there = stack.enter_context(machine(name))
                receivers[name] = there, connect(robot, there, number, mbit if name == "slow" else None)
        listen = [part for _, host in receivers.values() for part in ("--listen", f"tcp/{host}:{PORT}")]
        serve = Command("serve", "--robot", "bench", "--namespace", namespace.name, "--insecure", *listen, place=robot)
        serving = stack.enter_context(serve)
        joins, places = {}, {}
        for name, (place, host) in receivers.items():
            places[name] = stack.enter_context(own_namespace(name)).name
            join = Command("join", "bench", "--connect", f"tcp/{host}:{PORT}", "--into", places[name], place=place)
            joins[name] = stack.enter_context(join)
        processes = stack.enter_context(Processes())
        readers = {"beside the driver": processes.start(read_all, namespace.name)}
        readers |= {f"{name} link": processes.start(read_all, place) for name, place in places.items()}
        for pipe in readers.values():
            answer(pipe, PATIENCE_S)
        time.sleep(12 if far else 8 if mbit else 3)  # the clocks, and the mode of the slow one
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
        for event in events[name]:
            if event["event"] not in ("ready", "status", "connected"):
                print(f"           {event}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--sensors", type=int, nargs="+", default=[SMALL, LARGE])
    parser.add_argument("--slow-mbit", type=float, default=16)
    parser.add_argument("--far", type=float, nargs="+", default=[], metavar="MS")
    parser.add_argument("--jitter", type=float, default=0.0, metavar="MS")
    parser.add_argument("--loss", type=float, default=0.0, metavar="SHARE")
    parser.add_argument("--tcp", choices=["cubic", "bbr"], default="cubic")
    parser.add_argument("--loopback", action="store_true")
    options = parser.parse_args()
    for delay_ms in options.far:
        far = Far(delay_ms, options.jitter, options.loss, options.tcp)
        print(far)
        for sensors in options.sensors:
            measure(sensors, options.seconds, None, False, far)
    for sensors in options.sensors if not options.far else ():
        print("fast link")
        measure(sensors, options.seconds, None, options.loopback)
        if not options.loopback:
            print(f"a fast link, and one of {options.slow_mbit:g} Mbit/s")
            measure(sensors, options.seconds, options.slow_mbit, False)


if __name__ == "__main__":
    main()
