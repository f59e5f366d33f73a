"""Many robots at a router: what it costs to know how all of them are, in bytes and processor time per robot.

tools/bench robots [--seconds S] [--robots N] [--sensors N ...]

Each robot is a ``skin-bridge serve`` in a process of its own, all of one driver at 100 Hz, and calls one router. In
turns nobody lists them, and one ``skin-bridge list --watch`` does.
"""

from __future__ import annotations

import argparse
import os
import time
from contextlib import ExitStack
from statistics import mean

from links import Command
from processes import own_namespace
from record import LARGE, RATE_HZ, SMALL, driving

PORT = 7462
TURNS = 3


def measure(sensors: int, robots: int, seconds: float) -> None:
    print(f"  {robots} robots of {sensors} sensors at {RATE_HZ} Hz, {seconds:g} s, load {os.getloadavg()[0]:.1f}")
    at = f"tcp/127.0.0.1:{PORT}"
    with ExitStack() as stack:
        namespace = stack.enter_context(own_namespace())
        stack.enter_context(driving(namespace.name, sensors, "analogue"))
        router = stack.enter_context(Command("route", "--listen", at))
        serving = []
        for number in range(robots):
            where = ("--namespace", namespace.name, "--connect", at)
            serving.append(stack.enter_context(Command("serve", "--robot", f"robot{number}", *where)))
        time.sleep(3)
        alone, listed, lists, routes, told = [], [], [], [], []
        for _ in range(TURNS):
            alone.append(shares(serving, seconds))
            with Command("list", "--connect", at, "--watch") as listing:
                time.sleep(3)
                listing.begin()
                router.begin()
                listed.append(shares(serving, seconds))
                lists.append(listing.share())
                routes.append(router.share())
                status = [event for event in listing.end() if event["event"] == "status"]
            first, last = ({robot["robot"]: robot["bytes"] for robot in status[at]["robots"]} for at in (3, -1))
            told += [(last[name] - first.get(name, 0)) / (len(status) - 4) for name in last]
    print(f"    {mean(told):.0f} bytes a second and robot; of a core per robot:")
    print(f"    serve {100 * mean(alone):.2f} % while nobody lists, {100 * mean(listed):.2f} % while one does")
    print(f"    list {100 * mean(lists) / robots:.3f} %, route {100 * mean(routes) / robots:.3f} %")


def shares(serving: list[Command], seconds: float) -> float:
    """Of a core, of one robot on average, in the seconds that follow."""
    for command in serving:
        command.begin()
    time.sleep(seconds)
    return mean(command.share() for command in serving)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--sensors", type=int, nargs="+", default=[SMALL, LARGE])
    options = parser.parse_args()
    for sensors in options.sensors:
        measure(sensors, options.robots, options.seconds)


if __name__ == "__main__":
    main()
