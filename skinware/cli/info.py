"""``skin-info``: show drivers, services and readers of a namespace."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from skinware.bridge_state import as_lines
from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json, redraw, say, style, terminal_width
from skinware.text import (
    NO_VALUE,
    NOT_FRESH,
    age_text,
    age_text_ms,
    count_text,
    plural,
    rate_text,
    state_shown,
    table,
    words,
    wrapped,
)

if TYPE_CHECKING:
    from skinware.memory.namespace import Namespace

_WATCH_PERIOD_S = 1.0
_TIMES_OF_A_PATCH = {"interval 99 %": "interval", "delay 99 %": "age"}
"""Columns of a patch, where its driver publishes them: 99th percentile of the time between two updates of a module, and
of the age of an update when it was published."""
_ABOUT_TIMES = "99 %: 99th percentile; interval: time between two updates; delay: time until publication"
_INDENT = 2
_LIFE_COLOURS = {
    "live": "green",
    NOT_FRESH: "red",
    "paused": "cyan",
    "starting": "cyan",
    "silent": "yellow",
    "dead": "red",
}


@cli.command(
    "skin-info",
    "skin-info                       everything in this namespace",
    "skin-info roboskin --sensors    every sensor of one driver, in the order of its values",
    "skin-info --health              faults of sensors, as skin-calm found them",
    "skin-info --json | jq '.drivers[] | {name, rate_hz}'",
)
@click.argument("name", required=False)
@click.option("--sensors", is_flag=True, help="List the sensors of driver NAME in the order of its values.")
@click.option(
    "--health",
    is_flag=True,
    help="List sensors with a fault (stuck, noisy, dead ...), here and in the namespace calm.",
)
@click.option("--watch", is_flag=True, help="Update every second.")
@cli.namespace_option
@cli.json_option
def command(name: str | None, sensors: bool, health: bool, watch: bool, namespace: str | None, as_json: bool) -> None:
    """Show all drivers with their buses and patches, other services, and their readers.

    With NAME: only that driver or service.
    """
    from skinware.memory.namespace import Namespace

    place = Namespace(namespace)
    if health:
        from skinware.cli._report import show

        if sensors or watch:
            raise click.UsageError("--health stands alone: without --sensors and --watch")
        show([place] if namespace else [place, Namespace(place.calm_name)], name, as_json)
    elif sensors:
        from skinware.cli._report import sensors as sensors_of

        if name is None:
            raise click.UsageError("--sensors lists one driver: give its NAME")
        rows = sensors_of(place, name)
        cells = [[str(position), row["name"], row["type"], f"{row['uid']:#x}"] for position, row in enumerate(rows)]
        say(as_json, rows, "\n".join(table(("position", "name", "type", "uid"), cells, left=3)))
    elif watch:
        _watch(place, name, as_json)
    else:
        from skinware.cli._report import report

        found = report(place, name)
        say(as_json, found, "\n".join(as_text(found)))


def as_text(found: dict[str, Any]) -> list[str]:
    """Return the report for people, with colours, no wider than the terminal."""
    drivers, services = found["drivers"], found["services"]
    lines = [f"namespace {found['namespace']}: {plural(len(drivers), 'driver')}, {plural(len(services), 'service')}"]
    if not drivers and not services:
        lines += ["", "Nothing runs here yet. Start a driver:", "  skin-driver --bus virtual    (needs no hardware)"]
    for driver in drivers:
        lines += ["", *_driver_lines(driver)]
    for service in services:
        own = [*_content_lines(service), *_statistics_lines(service), "", *_reader_lines(service)]
        lines += ["", _life_line("service", service), *_indented(own)]
    if found["problems"]:
        lines += ["", *(style("problem: ", fg="red") + text for text in found["problems"])]
    return [part for line in lines for part in wrapped(line, terminal_width())]


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> list[str]:
    width = terminal_width()
    return table(titles, rows, left=left, width=None if width is None else width - _INDENT)


def _driver_lines(driver: dict[str, Any]) -> list[str]:
    from skinware.status import sample_text

    counts = [plural(driver["patches"], "patch", "patches"), plural(driver["modules"], "module")]
    size = ", ".join([*counts, plural(driver["sensors"], "sensor")])
    units = [f"{count_text(t['sensors'])} {t['name']}{' in ' * bool(t['unit'])}{t['unit']}" for t in driver["types"]]
    untouched = sum(patch["untouched"] for patch in driver["patch_list"])
    columns = [title for title in ("reason", "for", "load") if any(_columns_of(bus)[title] for bus in driver["buses"])]
    timed = _TIMES_OF_A_PATCH if any("interval" in patch for patch in driver["patch_list"]) else {}
    timed = {title: key for title, key in timed.items() if any(sum(p[key]["counts"]) for p in driver["patch_list"])}
    samples = [
        [bus["name"], words(sample["why"]), sample_text(sample)]
        for bus in driver["buses"]
        for sample in bus.get("samples", ())
    ]
    lines = [
        f"{driver['driver_type'] or 'unnamed'} driver: {size} ({driver['dtype']})",
        f"sensors: {', '.join(units)}{f'; {count_text(untouched)} untouched so far (only 0)' if untouched else ''}",
        "",
        *_counter_table(
            driver["buses"],
            ("bus", "state", *columns),
            lambda bus: (
                bus["name"],
                _state(driver, bus),
                *(_columns_of(bus)[title] or NO_VALUE for title in columns),
            ),
            {"frames", "dropped"},
        ),
        *(["", *table(("bus", "not used", "for example"), samples, left=3)] if samples else []),
        "",
        *_counter_table(
            driver["patch_list"],
            ("patch", "bus", "state", "fresh sensors", "age", *timed),
            lambda patch: (
                patch["name"],
                patch["bus"],
                _state(driver, patch),
                f"{count_text(patch['fresh'])} of {count_text(patch['sensors'])}",
                age_text_ms(patch["age_ms"]),
                *(_bound(patch[key]) for key in timed.values()),
            ),
            {"orphans"},
        ),
        *([_ABOUT_TIMES] if timed else []),
    ]
    in_python = ", ".join(bus["name"] for bus in driver["buses"] if bus.get("data_path") == "python")
    path = [f"Python receives the frames of {in_python}"] if in_python else []
    if driver["latency_ms"]:
        path.append(f"frames wait up to {driver['latency_ms']:g} ms to be taken together")
    lines += ["", "; ".join(path)] if path else []
    return [_life_line("driver", driver), *_indented([*lines, "", *_statistics_lines(driver), *_reader_lines(driver)])]


def _content_lines(service: dict[str, Any]) -> list[str]:
    if service.get("bridge") is not None:
        return [*as_lines(service["bridge"]["robot"], service["bridge"]), ""]
    rows = [
        [c["name"], _dtype_text(c["dtype"]), "x".join(map(str, c["shape"])) or "1", c["unit"], c["description"]]
        for c in service["columns"]
    ]
    titles = ["column", "dtype", "shape", "unit", "description"]
    while not any(row[-1] for row in rows) and len(titles) > 3:
        titles, rows = titles[:-1], [row[:-1] for row in rows]
    described = [service["description"]] if service["description"] else []
    return [*described, *table(titles, rows, left=len(titles))]


def _dtype_text(descr: Any) -> str:
    import numpy as np

    if isinstance(descr, str):
        return np.dtype(descr).name
    return "{" + ", ".join(f"{field[0]}: {_dtype_text(field[1])}" for field in descr) + "}"


def _statistics_lines(entry: dict[str, Any]) -> list[str]:
    statistics = entry["statistics"]
    wall, cpu = statistics["wall"], statistics["cpu"]
    if not wall["count"]:
        return []
    mean, worst, on_cpu = age_text(wall["mean_ns"]), age_text(wall["worst_ns"]), age_text(cpu["mean_ns"])
    lines = [f"a sample takes {mean} to fill (worst {worst}); with all else {on_cpu} of processor time"]
    lines.append(f"99 % of its samples are published at most {_bound(statistics['age'])} after their newest data")
    if statistics["lateness"]["p99_ns"] is not None:
        lines.append(f"99 % of its periods begin up to {_bound(statistics['lateness'])} late")
    return lines


def _bound(histogram: dict[str, Any]) -> str:
    return age_text(histogram["p99_ns"])


def _state(driver: dict[str, Any], part: dict[str, Any]) -> str:
    """Return the state of a bus or patch; ``was live`` if the driver publishes nothing new."""
    if part["state"] is None:
        return NO_VALUE
    if driver["state"] != "live":
        return f"was {part['state']}"
    return state_shown(part["state"], part["fresh"], part["sensors"]) if "fresh" in part else part["state"]


def _columns_of(bus: dict[str, Any]) -> dict[str, str]:
    """Return the texts of a bus that are shown where any bus has one."""
    age_s, load = bus.get("state_age_s"), bus.get("load")
    load_text = "" if load is None else f"{100 * load:.0f} %"
    return {
        "reason": (bus.get("reason") or "").replace("_", "-"),
        "for": "" if age_s is None else age_text(age_s * 1e9),
        "load": "unknown (filter)" if bus.get("load_unknown") == "filter" else load_text,
    }


def _life_line(what: str, entry: dict[str, Any]) -> str:
    life, age = entry["state"], age_text_ms(entry["age_ms"])
    patches = entry.get("patch_list", ())
    shown = state_shown(life, sum(patch["fresh"] for patch in patches), entry.get("sensors", 0))
    parts = [style(life, fg=_LIFE_COLOURS.get(shown), bold=True)]
    if shown == NOT_FRESH:
        parts.append(style("but no sensor is fresh", fg="red"))
    if entry["age_ms"] is None:
        parts.append("nothing published yet")
    elif life == "dead":
        parts += [f"its last data is {age} old and stays readable", f"{count_text(entry['sequence'])} samples"]
    elif life == "silent":
        parts += [f"its process runs but publishes nothing, newest data {age} old"]
    else:
        parts += [rate_text(entry["rate_hz"]), f"newest data {age} old", f"sample {count_text(entry['sequence'])}"]
    if entry["missed_periods"]:
        parts.append(f"{plural(entry['missed_periods'], 'period')} missed")
    if entry["before_boot"]:
        parts.append(f"{plural(entry['before_boot'], 'sample')} stamped before this machine booted")
    if entry["ahead"]:
        parts.append(f"{plural(entry['ahead'], 'sample')} stamped in the future, with nothing fresh")
    parts.append(f"pid {entry['pid']}")
    return f"{what} {style(entry['name'], bold=True)}: {', '.join(parts)}"


_OWN_KEYS = {"name", "state", "reason", "state_age_s", "load", "load_unknown", "samples", "data_path"}
_OWN_KEYS |= {"bus", "age_ms", "modules", "sensors", "fresh"}
_OWN_KEYS |= set(_TIMES_OF_A_PATCH.values())


def _counter_table(
    rows: list[dict[str, Any]],
    titles: tuple[str, ...],
    cells: Callable[[dict[str, Any]], tuple[str, ...]],
    always: set[str],
) -> list[str]:
    """Return rows with their counters that are not 0 everywhere, and with those in ``always``."""
    names = [key for key in dict.fromkeys(key for row in rows for key in row) if key not in _OWN_KEYS]
    shown = [name for name in names if name in always or any(row.get(name) for row in rows)]
    return _table(
        [*titles, *map(words, shown)],
        [[*cells(row), *(count_text(row.get(name)) for name in shown)] for row in rows],
        left=min(len(titles), 3),
    )


def _reader_lines(entry: dict[str, Any]) -> list[str]:
    if not entry["readers"]:
        return ["no readers"]
    rows = [
        [
            reader["program"],
            reader["kind"],
            str(reader["pid"]),
            rate_text(reader["rate_hz"]),
            age_text_ms(reader["age_ms"]),
            _bound(reader["age"]),
            age_text(reader["wall"]["mean_ns"] if reader["wall"]["count"] else None),
            age_text(reader["cpu"]["mean_ns"] if reader["cpu"]["count"] else None),
            count_text(reader["frames"]),
            count_text(reader["missed"]),
        ]
        for reader in entry["readers"]
    ]
    titles = ("reader", "how", "pid", "rate", "data age", "age 99 %", "its loop", "CPU", "frames", "not taken")
    return _table(titles, rows, left=2)


def _indented(lines: list[str]) -> list[str]:
    return [" " * _INDENT + line if line else "" for line in lines]


def _watch(namespace: Namespace, name: str | None, as_json: bool) -> None:
    from skinware.cli._report import report
    from skinware.errors import ServiceNotFound

    while True:
        try:
            found = report(namespace, name)
        except ServiceNotFound as error:  # it may start later
            found = {"namespace": namespace.name, "drivers": [], "services": [], "problems": [str(error)]}
        if as_json:
            print_json(found)
        elif sys.stdout.isatty():
            redraw(as_text(found))
        else:
            echo("\n".join([time.strftime("%H:%M:%S"), *as_text(found), ""]))
        time.sleep(_WATCH_PERIOD_S)


main = partial(cli.run, command)
