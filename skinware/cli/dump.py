"""``skin-dump``: print frames."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import json_option, namespace_option, print_json, run

if TYPE_CHECKING:
    from skinware.driver_service import DriverFrame, DriverReader
    from skinware.memory.namespace import Namespace


@click.command("skin-dump")
@click.argument("name", required=False)
@click.option("-n", "count", type=click.IntRange(min=1), help="Stop after this many frames.")
@click.option("-T", "timeout_s", type=float, help="Stop (with exit status 1) after this many seconds without a frame.")
@click.option("--type", "type_name", metavar="TYPE", help="Only sensors of this type, such as pressure.")
@click.option("--physical", is_flag=True, help="With --type: values in the type's unit instead of raw counts.")
@click.option("--rate", "rate_hz", type=float, help="The newest frame at this rate; otherwise every frame in order.")
@namespace_option
@json_option
def command(
    name: str | None,
    count: int | None,
    timeout_s: float | None,
    type_name: str | None,
    physical: bool,
    rate_hz: float | None,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Print the frames of driver NAME (or of the only driver there is)."""
    from skinware.memory.namespace import Namespace

    if physical and not type_name:
        raise click.UsageError("--physical needs --type: each type has its own unit")
    place = Namespace(namespace)
    with _attach(place, name, timeout_s) as reader:
        if type_name:
            reader.structure.type(type_name)
        for taken, frame in enumerate(_frames(reader, rate_hz, timeout_s), start=1):
            if as_json:
                print_json(as_data(reader, frame, type_name, physical))
            else:
                click.echo(as_line(reader, frame, type_name))
            if taken == count:
                return


def as_data(reader: DriverReader, frame: DriverFrame, type_name: str | None, physical: bool) -> dict[str, Any]:
    """One frame as JSON prints it."""
    index = frame.structure.index(type_name) if type_name else slice(None)
    values = frame.physical(type_name) if type_name and physical else frame.values[index]
    data = {
        "driver": reader.name,
        "sequence": frame.sequence,
        "acquired_ns": frame.acquired_ns,
        "age_ms": round(frame.age_ns / 1e6, 3),
        "values": values.tolist(),
        "status": frame.status[index].tolist(),
        "lost": reader.lost,
    }
    if type_name:
        data["uids"] = frame.structure.sensor_uid[index].tolist()
    return data


def as_line(reader: DriverReader, frame: DriverFrame, type_name: str | None) -> str:
    """One frame for people: per type, the least, mean and greatest physical value."""
    parts = []
    for sensor_type in frame.structure.types:
        if type_name in (None, sensor_type.name):
            values = frame.physical(sensor_type.name)
            least, mean, most = values.min(), values.mean(), values.max()
            parts.append(f"{sensor_type.name} {least:.4g} / {mean:.4g} / {most:.4g} {sensor_type.unit}")
    not_fresh = int((frame.status != 0).sum())
    age_ms = frame.age_ns / 1e6
    return f"{reader.name} #{frame.sequence}  age {age_ms:.1f} ms  {'  '.join(parts)}  not fresh {not_fresh}"


def _attach(namespace: Namespace, name: str | None, timeout_s: float | None) -> DriverReader:
    from skinware.driver_service import DriverReader
    from skinware.errors import ConfigurationError, ServiceNotFound

    if name is None:
        names = namespace.services()
        if len(names) > 1:
            raise ConfigurationError(f"which driver? namespace {namespace.name!r} has: {', '.join(names)}")
        if not names:
            raise ServiceNotFound(f"no driver in namespace {namespace.name!r}; start one: skin-driver --bus virtual")
        name = names[0]
    return DriverReader(name, namespace=namespace, timeout_s=timeout_s or 0.0)


def _frames(reader: DriverReader, rate_hz: float | None, timeout_s: float | None) -> Iterator[DriverFrame]:
    """Frames for ever, over restarts with another structure too."""
    from skinware.errors import StructureChanged

    while True:
        try:
            yield from reader.frames(rate_hz) if rate_hz else reader.in_order(timeout_s=timeout_s)
        except StructureChanged:
            reader.reattach()
            print(f"skin-dump: {reader.name} came back as {reader.structure!r}", file=sys.stderr)  # noqa: T201


def main() -> None:
    """Entry point."""
    run(command)
