"""``skin-info``: who publishes in a namespace, and who reads."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import json_option, namespace_option, print_json, run

if TYPE_CHECKING:
    from skinware.driver_service import DriverReader
    from skinware.memory.namespace import Namespace
    from skinware.service import ServiceReader


@click.command("skin-info")
@click.argument("name", required=False)
@click.option("--sensors", is_flag=True, help="List the sensors of driver NAME in frame order.")
@click.option("--watch", is_flag=True, help="Again every second, until interrupted.")
@namespace_option
@json_option
def command(name: str | None, sensors: bool, watch: bool, namespace: str | None, as_json: bool) -> None:
    """Show the drivers and services of a namespace, their buses and patches, and who reads them."""
    from skinware.memory.namespace import Namespace

    place = Namespace(namespace)
    if sensors:
        if name is None:
            raise click.UsageError("--sensors lists one driver: give its NAME")
        _show_sensors(place, name, as_json)
        return
    while True:
        report = collect(place, name)
        if as_json:
            print_json(report)
        else:
            if watch:
                click.clear()
            click.echo(as_text(report))
        if not watch:
            return
        time.sleep(1)


def collect(namespace: Namespace, only: str | None = None) -> dict[str, Any]:
    """Everything that can be seen of a namespace, as JSON prints it.

    Raises:
        ServiceNotFound: ``only`` names nothing here.
        NamespaceError: the namespace cannot be trusted or read.
    """
    from skinware.driver_service import DriverReader
    from skinware.errors import BadServiceFile, ServiceNotFound
    from skinware.memory.announcement import living_readers
    from skinware.service import ServiceReader

    drivers: list[dict[str, Any]] = []
    services: list[dict[str, Any]] = []
    problems: list[str] = []
    readers = [{name: getattr(r, name) for name in r.__struct_fields__} for r in living_readers(namespace)]
    for name in [only] if only else namespace.services():
        own = [r for r in readers if r["service"] == name]
        try:
            service: ServiceReader[Any]
            with ServiceReader(name, namespace=namespace, announce=False) as service:
                common = _common(service, own)
                if service.kind != "driver":
                    services.append(common)
                    continue
            with DriverReader(name, namespace=namespace, announce=False) as driver:
                drivers.append({**common, **_driver(driver)})
        except ServiceNotFound:
            if only:
                raise
        except BadServiceFile as error:
            problems.append(str(error))
    report: dict[str, Any] = {"namespace": namespace.name, "drivers": drivers, "services": services}
    return {**report, "problems": problems} if problems else report


def _common(service: ServiceReader[Any], readers: list[dict[str, Any]]) -> dict[str, Any]:
    latest = service.latest
    frame = service.read(timeout_s=0) if latest else None
    return {
        "name": service.name,
        "alive": service.alive,
        "paused": service.paused,
        "pid": service.writer_pid,
        "generation": service.generation,
        "sequence": latest[1] if latest else 0,
        "rate_hz": service.rate_hz(),
        "age_ms": round(frame.age_ns / 1e6, 3) if frame else None,
        "missed_periods": service.missed_periods,
        "readers": readers,
    }


def _driver(driver: DriverReader) -> dict[str, Any]:
    from skinware.status import BusState, PatchState

    structure = driver.structure
    counts = [int((structure.sensor_type == t.id).sum()) for t in structure.types]
    told: dict[str, Any] = {
        "driver_type": driver.driver_type,
        "dtype": structure.dtype.name,
        "sensors": structure.n_sensors,
        "modules": structure.n_modules,
        "patches": structure.n_patches,
        "types": [{"name": t.name, "sensors": n, "unit": t.unit} for t, n in zip(structure.types, counts, strict=True)],
        "buses": [{"name": name} for name in structure.buses],
        "patch_list": [],
    }
    if driver.latest is None:
        return told
    frame = driver.read(timeout_s=0)
    for bus, state, counters in zip(told["buses"], frame.bus_state, driver.bus_counters(frame), strict=True):
        bus |= {"state": BusState(state).name.lower(), **counters}
    names = [bytes(name).decode() for name in structure.patch_name]
    for patch, counters in enumerate(driver.patch_counters(frame)):
        state = PatchState(frame.patch_state[patch]).name.lower()
        bus_name = structure.buses[structure.patch_bus[patch]]
        fresh = int((frame.status[structure.patch_index(patch)] == 0).sum())
        told["patch_list"].append(
            {"name": names[patch], "bus": bus_name, "state": state, "fresh_sensors": fresh, **counters}
        )
    return told


def as_text(report: dict[str, Any]) -> str:
    """The report for people."""
    lines = [f"namespace {report['namespace']}"]
    if not report["drivers"] and not report["services"]:
        lines.append("  nothing here yet; start a driver: skin-driver --bus virtual")
    for driver in report["drivers"]:
        types = ", ".join(f"{t['sensors']} {t['name']}" for t in driver["types"])
        lines.append(f"driver {driver['name']} ({driver['driver_type']}): {_life(driver)}")
        lines.append(f"  {driver['patches']} patches, {driver['modules']} modules, {types}")
        lines += _table(driver["buses"], "  bus")
        lines += _table(driver["patch_list"], "  patch")
        lines += _readers(driver)
    for service in report["services"]:
        lines.append(f"service {service['name']}: {_life(service)}")
        lines += _readers(service)
    lines += [f"problem: {problem}" for problem in report.get("problems", ())]
    return "\n".join(lines)


def _life(entry: dict[str, Any]) -> str:
    rate = f"{entry['rate_hz']:.1f} Hz" if entry["rate_hz"] else "no rate yet"
    age = "nothing published" if entry["age_ms"] is None else f"newest data {entry['age_ms']:.0f} ms old"
    life = f"pid {entry['pid']}" if entry["alive"] else "DEAD (its last frame stays readable)"
    return f"{life}, {rate}, {age}"


def _readers(entry: dict[str, Any]) -> list[str]:
    shown = [{k: v for k, v in reader.items() if k != "service"} for reader in entry["readers"]]
    return _table(shown, "  reader") or ["  no readers"]


def _table(rows: list[dict[str, Any]], title: str) -> list[str]:
    """Rows of equal keys as aligned columns, with the keys above them; columns of zeros only are left out."""
    if not rows:
        return []
    keys = [key for key in rows[0] if any(row.get(key) not in (0, None) for row in rows)]
    cells = [[key.replace("_", " ") for key in keys]] + [[str(row.get(key, "")) for key in keys] for row in rows]
    widths = [max(len(line[column]) for line in cells) for column in range(len(keys))]
    padded = ["  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip() for line in cells]
    return [f"{title}  {line}" if n == 0 else f"{' ' * len(title)}  {line}" for n, line in enumerate(padded)]


def _show_sensors(namespace: Namespace, name: str, as_json: bool) -> None:
    from skinware.driver_service import DriverReader

    with DriverReader(name, namespace=namespace, announce=False) as driver:
        structure = driver.structure
    type_name = {t.id: t.name for t in structure.types}
    columns = (structure.sensor_uid, structure.sensor_type, structure.sensor_module, structure.sensor_patch)
    rows = [
        {"uid": uid, "type": type_name[kind], "module": module, "patch": patch}
        for uid, kind, module, patch in zip(*(column.tolist() for column in columns), strict=True)
    ]
    if as_json:
        print_json(rows)
    else:
        for row in rows:
            click.echo(f"{row['uid']:#018x}  {row['type']:<16}  module {row['module']:<5}  patch {row['patch']}")


def main() -> None:
    """Entry point."""
    run(command)
