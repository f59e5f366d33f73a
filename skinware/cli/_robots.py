"""``skin-bridge route`` and ``skin-bridge list``: a router for many robots, and the state of all of them."""

from __future__ import annotations

import contextlib
import itertools
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json, redraw, say, style, terminal_width
from skinware.errors import BridgeError
from skinware.realtime import NS_PER_S, now_ns
from skinware.text import NO_VALUE, age_text_ms, count_text, plural, rate_text, state_shown, table

if TYPE_CHECKING:
    from skinware.bridge.watching import Seen

_PORT = 7447
_PATIENCE_S = 3
"""How long to wait for the summaries of robots; a robot without one for this long is silent."""
_TITLES = ("robot", "driver", "state", "rate", "age", "fresh sensors", "dropped", "silent patches", "problems", "clock")
connect_option = click.option(
    "--connect", multiple=True, required=True, metavar="ENDPOINT", help="Robot or router: tcp/HOST:PORT."
)


@click.command(
    "route",
    epilog=cli.examples(
        "skin-bridge route --listen tls/0.0.0.0:7447 --tls certs            the router",
        "skin-bridge serve --robot icub --connect tls/router.lab:7447 --tls certs   on a robot",
        "skin-bridge join icub --connect tls/router.lab:7447 --tls certs            on another machine",
    ),
)
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help=f"Where others connect.  [default: tcp/127.0.0.1:{_PORT}]",
)
@click.option(
    "--connect", multiple=True, metavar="ENDPOINT", help="Another router, whose robots are reached here, too."
)
@cli.tls_option()
@cli.caller_option
@click.option(
    "--robot",
    "robots",
    multiple=True,
    metavar="R",
    help="Only certificates of this name may serve, and only robot R; may be repeated.",
)
@click.option(
    "--router",
    "routers",
    multiple=True,
    metavar="NAME",
    help="Certificate name of another router; may be repeated.",
)
@cli.insecure_option
@cli.json_option
def route(
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    tls: Path | None,
    callers: tuple[str, ...],
    robots: tuple[str, ...],
    routers: tuple[str, ...],
    insecure: bool,
    as_json: bool,
) -> None:
    """Run a router: one address where robots and their users meet. It reads no samples.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.bridge.endpoints import DEFAULT_ROUTER, Rules, endpoints
    from skinware.bridge.link import ZenohLink
    from skinware.bridge.watching import Watcher

    places = endpoints(
        listen=listen or (DEFAULT_ROUTER,),
        connect=connect,
        tls=tls,
        rules=Rules(callers, True, robots, routers),
        insecure=insecure,
    )
    with contextlib.closing(ZenohLink(places)) as link:
        watcher = Watcher(link, asks=False)
        with cli.signals_end(watcher.stop):
            ready = {"event": "ready", "listen": list(places.listen), "connect": list(places.connect)}
            say(as_json, ready, f"router: {places} (Ctrl-C ends)")
            shown: dict[str, str] = {}

            def report() -> None:
                count = Counter(seen.robot for seen in watcher.robots())
                if as_json:
                    print_json({"event": "status", "robots": dict(count)})
                    return
                states = dict.fromkeys(shown, "gone")
                for robot, n in count.items():
                    states[robot] = "there" if n == 1 else f"{n} robots have this name"
                cli.echo_changes(shown, dict(sorted(states.items())))

            watcher.run(report)


@click.command(
    "list",
    epilog=cli.examples(
        "skin-bridge list --connect tcp/192.168.1.10:7448 --connect tcp/192.168.1.11:7448",
        "skin-bridge list --connect tls/router.lab:7447 --tls certs --watch   all robots, every second",
    ),
)
@connect_option
@cli.tls_option()
@click.option("--watch", is_flag=True, help="Update every second.")
@cli.json_option
def list_robots(connect: tuple[str, ...], tls: Path | None, watch: bool, as_json: bool) -> None:
    """Show the drivers of all robots that are reached: rate, age, losses, silent patches, problems, clock error.

    Each robot sends one small message a second for this, and no samples.

    Exit status: 0 done or interrupted, 1 no robot reached, 2 wrong usage.
    """
    from skinware.bridge.endpoints import endpoints, why_unreachable
    from skinware.bridge.link import ZenohLink
    from skinware.bridge.watching import Watcher

    places = endpoints(connect=connect, tls=tls)
    with contextlib.closing(ZenohLink(places)) as link:
        watcher, seconds = Watcher(link), itertools.count(1)

        def report() -> None:
            second, robots = next(seconds), watcher.robots()
            if not watch:
                if second < _PATIENCE_S and not (robots and all(seen.summary for seen in robots)):
                    return
                watcher.stop()
            found = _report(robots)
            if not robots and second % _PATIENCE_S == 0:
                why = " ".join(filter(None, (why_unreachable(at, tls) for at in places.connect)))
                why = why or "something listens there, but no robot answers; does it want --tls?"
                if not watch:
                    raise BridgeError(why)
                found["problems"].append(why)
            if as_json:
                print_json(found)
            elif watch and sys.stdout.isatty():
                redraw(_as_text(found))
            else:
                echo("\n".join(_as_text(found)))

        if watch and as_json:
            print_json({"event": "ready", "connect": list(places.connect)})
        with cli.signals_end(watcher.stop):
            watcher.run(report)


def _report(robots: Sequence[Seen]) -> dict[str, Any]:
    count = Counter(seen.robot for seen in robots)
    problems = [f"{n} robots are called {name}: give each a name of its own" for name, n in count.items() if n > 1]
    problems += [
        f"{plural(seen.guard.count, 'message')} of {seen.robot} could not be read; the last: {seen.guard.last}"
        for seen in robots
        if seen.guard.count
    ]
    entries = []
    for seen in robots:
        told_s = (now_ns() - seen.heard_ns) / NS_PER_S if seen.heard_ns else None
        clock = {
            "offset_ms": seen.clock.offset_ns(now_ns()) / 1e6,
            "error_ms": seen.clock.error_ns / 1e6,
            "round_trip_ms": seen.clock.round_trip_ns / 1e6,
        }
        entry = {
            "robot": seen.robot,
            "instance": seen.instance,
            "version": seen.version,
            "state": "starting" if told_s is None else "live" if told_s < _PATIENCE_S else "silent",
            "told_s": told_s,
            "bytes": seen.bytes,
            "refused": seen.guard.count,
            "last_refused": seen.guard.last or None,
            "clock": clock if seen.clock.is_known else None,
        }
        entries.append(entry | ({} if seen.summary is None else msgspec.to_builtins(seen.summary)))
    return {"event": "status", "robots": entries, "problems": problems}


def _as_text(found: dict[str, Any]) -> list[str]:
    lines = [plural(len(found["robots"]), "robot")]
    count = Counter(robot["robot"] for robot in found["robots"])
    rows = [row for robot in found["robots"] for row in _rows_of(robot, count[robot["robot"]] > 1)]
    if rows:
        lines += table(_TITLES, rows, left=3, width=terminal_width())
    return [*lines, *(style("problem: ", fg="red") + text for text in found["problems"])]


def _rows_of(robot: dict[str, Any], has_namesakes: bool) -> list[tuple[str, ...]]:
    called = (
        f"{robot['robot']} ({robot.get('host') or '?'}, {robot['instance'][:8]})" if has_namesakes else robot["robot"]
    )
    clock = robot["clock"]
    error = NO_VALUE if clock is None else f"± {age_text_ms(clock['error_ms'])}"
    nothing = (NO_VALUE,) * 6
    if not robot.get("drivers"):
        return [(called, NO_VALUE, robot["state"], *nothing, error)]
    rows: list[tuple[str, ...]] = []
    for name, driver in robot["drivers"].items():
        state = f"was {driver['state']}"
        if robot["state"] == "live":
            state = state_shown(driver["state"], driver["fresh"], driver["sensors"])
        silent, more = ", ".join(driver["silent"]), driver["n_silent"] - len(driver["silent"])
        figures = (
            rate_text(driver["rate_hz"]),
            age_text_ms(driver["age_ms"]),
            f"{count_text(driver['fresh'])} of {count_text(driver['sensors'])}",
            count_text(driver["dropped"]),
            f"{silent} and {more} more" if more else silent or NO_VALUE,
            count_text(driver["problems"]),
        )
        rows.append((called, name, state, *figures, error))
    return rows
