"""Collect what skin-info shows of a namespace, and the health of sensors, without announcing a reader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import msgspec
import numpy as np

from skinware import bridge_state
from skinware.cli._terminal import say, style, terminal_width
from skinware.driver_service import KIND, DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import BadServiceFile, ConfigurationError, Overrun, ServiceNotFound, ServiceTimeout
from skinware.memory.announcement import MOST_ANNOUNCEMENTS, ReaderRecord, living_readers
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.memory.statistics import Histogram, WriterStatistics
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import ServiceReader
from skinware.state import DriverReport, life_of, rate_now_hz, report_of
from skinware.status import DataPath, load_report, sample_report
from skinware.structure import Structure
from skinware.tactile.health import HealthKind, HealthReport
from skinware.tactile.health_service import NAME as HEALTH_KIND
from skinware.tactile.health_service import HealthReader, HealthSample
from skinware.text import age_text_ms, count_text, plural, table, words, wrapped

SampleT = TypeVar("SampleT", bound=Sample)


def report(namespace: Namespace, only: str | None = None) -> dict[str, Any]:
    """Return everything that can be seen of a namespace, as ``skin-info --json`` prints it."""
    drivers: list[dict[str, Any]] = []
    services: list[dict[str, Any]] = []
    problems: list[str] = []
    readers = [msgspec.structs.asdict(record) | _times(record) for record in living_readers(namespace)]
    if len(list(namespace.reader_files(MOST_ANNOUNCEMENTS + 1))) > MOST_ANNOUNCEMENTS:
        folder = namespace.readers_path
        problems.append(f"{folder}: more than {MOST_ANNOUNCEMENTS} files; readers may be missing here; empty it")
    for name in [only] if only is not None else namespace.services():
        try:
            entry = _describe(namespace, name)
        except BadServiceFile as error:
            problems.append(str(error))
            continue
        except (ServiceNotFound, ConfigurationError) as error:
            if only is not None:
                raise
            if isinstance(error, ConfigurationError):  # the name of the file cannot be that of a service
                problems.append(f"{namespace.ring_path(name)}: {error}")
            continue  # otherwise it has just been withdrawn
        entry["readers"] = [record for record in readers if record["service"] == name]
        (drivers if entry["kind"] == KIND else services).append(entry)
    return {"namespace": namespace.name, "drivers": drivers, "services": services, "problems": problems}


def sensors(namespace: Namespace, driver: str) -> list[dict[str, Any]]:
    with DriverReader(driver, namespace=namespace, announce=False) as reader:
        structure = reader.structure
    names = {sensor_type.id: sensor_type.name for sensor_type in structure.types}
    columns = (structure.sensor_uid, structure.sensor_type, structure.sensor_module, structure.sensor_patch)
    return [
        {
            "name": structure.sensor_name(position),
            "uid": uid,
            "type": names[type_id],
            "module": module,
            "patch": patch,
        }
        for position, (uid, type_id, module, patch) in enumerate(
            zip(*(column.tolist() for column in columns), strict=True)
        )
    ]


def _describe(namespace: Namespace, name: str) -> dict[str, Any]:
    with ServiceReader[Sample](name, namespace=namespace, announce=False) as service:
        if service.kind == KIND:
            with DriverReader(name, namespace=namespace, announce=False) as driver:
                frame = _newest(driver)
                common = _common(driver, frame)
                return {**common, **_skin(driver, frame, common["state"])}
        entry = _common(service, _newest(service))
        entry["description"] = service.schema.description
        entry["columns"] = [
            {
                "name": column_name,
                "dtype": np.lib.format.dtype_to_descr(column.dtype),
                "shape": column.shape,
                "unit": column.unit,
                "description": column.description,
            }
            for column_name, column in service.schema.columns.items()
        ]
        if service.kind == bridge_state.KIND:
            with bridge_state.BridgeReader(name, namespace=namespace, announce=False) as bridge:
                newest = _newest(bridge)  # None before its first sample
                state = None if newest is None else {"robot": newest.state.robot, **bridge_state.as_data(newest.state)}
            entry["bridge"] = state
        return entry


def _newest(service: ServiceReader[SampleT]) -> SampleT | None:
    try:
        return service.latest()
    except Overrun:
        return None  # its writer is too fast for a copy


def _common(service: ServiceReader[Any], frame: Sample | None) -> dict[str, Any]:
    life = life_of(service, frame)
    statistics = service.writer_statistics
    return {
        "name": service.name,
        "kind": service.kind,
        "state": life,
        "alive": service.alive,
        "paused": service.paused,
        "pid": service.writer_pid,
        "rate_hz": rate_now_hz(life, service.rate_hz()),
        "sequence": frame.sequence if frame else 0,
        "age_ms": round(frame.age_ns / 1e6, 3) if frame else None,
        "missed_periods": statistics.missed_periods,
        "before_boot": statistics.before_boot,
        "ahead": statistics.ahead,
        "generation": service.generation,
        "statistics": _times(statistics),
    }


def _times(of: WriterStatistics | ReaderRecord) -> dict[str, Any]:
    spreads = {
        name: {"count": s.count, "best_ns": s.best_ns, "mean_ns": round(s.mean_ns), "worst_ns": s.worst_ns}
        for name, s in (("wall", of.wall), ("cpu", of.cpu))
    }
    return spreads | {"age": _histogram(of.age), "lateness": _histogram(of.lateness)}


def _histogram(h: Histogram) -> dict[str, Any]:
    return {"p50_ns": h.quantile_ns(0.5), "p99_ns": h.quantile_ns(0.99), "counts": h.counts}


def _skin(driver: DriverReader, frame: DriverSnapshot | None, life: str) -> dict[str, Any]:
    structure = driver.structure
    report = report_of(driver, frame, life=life)
    return {
        "driver_type": driver.driver_type,
        "dtype": structure.dtype.name,
        "data_path": frame.data_path.name.lower() if frame else None,
        "latency_ms": frame.latency_ns / 1e6 if frame else None,
        "sensors": structure.n_sensors,
        "modules": structure.n_modules,
        "patches": structure.n_patches,
        "types": [
            {"name": t.name, "sensors": int((structure.sensor_type == t.id).sum()), "unit": t.unit}
            for t in structure.types
        ],
        "buses": _buses(structure, frame, report),
        "patch_list": _patches(structure, frame, report),
    }


def _buses(structure: Structure, frame: DriverSnapshot | None, report: DriverReport) -> list[dict[str, Any]]:
    if frame is None:
        return [{"name": name, "state": None} for name in structure.buses]
    time_ns = now_ns()
    entries = []
    for at, bus in enumerate(report.buses):
        since_ns = int(frame.bus_since_ns[at])
        own = {
            "name": bus.name,
            "state": bus.state,
            "reason": bus.reason,
            "state_age_s": round((time_ns - since_ns) / NS_PER_S, 3) if since_ns else None,
            **load_report(int(frame.bus_load[at])),
            "data_path": DataPath(int(frame.bus_data_path[at])).name.lower(),
            "samples": sample_report(frame.bus_samples[at]),
        }
        entries.append(_with_counters(own, bus.counters))
    return entries


def _patches(structure: Structure, frame: DriverSnapshot | None, report: DriverReport) -> list[dict[str, Any]]:
    modules, sensors = (
        np.bincount(patches, minlength=structure.n_patches).tolist()
        for patches in (structure.module_patch, structure.sensor_patch)
    )
    entries: list[dict[str, Any]] = []
    for at, (name, bus) in enumerate(zip(structure.patch_names, structure.patch_bus.tolist(), strict=True)):
        entry = {"name": name, "bus": structure.buses[bus], "state": None, "age_ms": None}
        entries.append(entry | {"modules": modules[at], "sensors": sensors[at], "fresh": 0, "untouched": 0})
    if frame is None:
        return entries
    for at, (entry, patch) in enumerate(zip(entries, report.patches, strict=False)):  # none while the structure changes
        entry["state"] = patch.state
        entry["age_ms"] = None if patch.age_ns is None else round(patch.age_ns / 1e6, 3)
        entry["fresh"], entry["untouched"] = patch.fresh, patch.untouched
        entry["interval"] = _histogram(Histogram(frame.patch_interval_counts[at].tolist()))
        entry["age"] = _histogram(Histogram(frame.patch_age_counts[at].tolist()))
        entries[at] = _with_counters(entry, patch.counters)
    return entries


def _with_counters(own: dict[str, Any], counters: dict[str, int]) -> dict[str, Any]:
    """Return an entry with counters after its own keys; a counter never replaces one of them."""
    return own | {name: count for name, count in counters.items() if name not in own}


_NOTHING = """\
No service publishes the health of sensors here. For a driver NAME:
  skin-calm NAME    (publishes it beside the calmed driver, in the namespace calm)"""
_FAULT_COLOUR = "yellow"


def show(namespaces: Sequence[Namespace], driver: str | None, as_json: bool) -> None:
    entries: list[dict[str, Any]] = []
    problems: list[str] = []
    for namespace in namespaces:
        for name in namespace.services():
            try:
                entry = _entry(namespace, name, driver)
            except ServiceNotFound:
                continue  # it has just been withdrawn
            except BadServiceFile as error:
                problems.append(str(error))
                continue
            entries += [entry] if entry is not None else []
    found = {"health": entries, "problems": problems}
    if driver is not None and not (found["health"] or found["problems"]):
        raise ServiceNotFound(f"no service publishes the health of driver {driver!r}; start one: skin-calm {driver}")
    say(as_json, found, "\n".join(part for line in as_text(found) for part in wrapped(line, terminal_width())))


def as_text(found: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    for entry in found["health"]:
        kinds = ", ".join(f"{count_text(count)} {words(kind)}" for kind, count in entry["kinds"].items() if count)
        name = style(entry["driver"], bold=True)
        age = "" if entry["state"] == "live" else f" ({entry['state']}, as of {age_text_ms(entry['age_ms'])} ago)"
        lines += [f"{name} in namespace {entry['namespace']}: {plural(entry['sensors'], 'sensor')}: {kinds}{age}"]
        rows = [(fault["name"], fault["type"], fault["kind"], fault["evidence"]) for fault in entry["faults"]]
        head, *body = table(("sensor", "type", "fault", "evidence"), rows, left=4)
        lines += [f"  {head}", *(style(f"  {line}", fg=_FAULT_COLOUR) for line in body)] if rows else []
        lines += [""]
    lines = lines[:-1] or [_NOTHING]
    return lines + [style("problem: ", fg="red") + text for text in found["problems"]]


def _entry(namespace: Namespace, name: str, driver: str | None) -> dict[str, Any] | None:
    """Return the health that a service publishes; None for another service or driver, and before a sample."""
    with ServiceReader[Any](name, namespace=namespace, announce=False) as service:
        if service.kind != HEALTH_KIND:
            return None
    with HealthReader(name, namespace=namespace, announce=False) as reader:
        source = reader.source
        if driver not in (None, source.driver):
            return None
        try:
            frame = reader.read(timeout_s=0.0)
        except (ServiceTimeout, Overrun):
            return None
        state = life_of(reader, frame)
    report = frame.report
    known = np.isfinite(report.still_s)
    counts = np.bincount(report.kind[known], minlength=len(HealthKind)).tolist()
    kinds = {kind.name.lower(): counts[kind] for kind in HealthKind} | {"unknown": int((~known).sum())}
    return {
        "driver": source.driver,
        "namespace": namespace.name,
        "service": name,
        "state": state,
        "age_ms": round(frame.age_ns / 1e6, 3),
        "sensors": len(known),
        "kinds": kinds,
        "faults": _faults(namespace, frame, report),
    }


def _faults(namespace: Namespace, frame: HealthSample, report: HealthReport) -> list[dict[str, Any]]:
    source = frame.source
    with DriverReader(source.driver, namespace=namespace, announce=False) as reader:
        structure = reader.structure
    if not np.array_equal(structure.sensor_uid, source.uid):
        raise ServiceNotFound(f"{source.driver!r} has just changed")
    types = {sensor_type.id: sensor_type for sensor_type in structure.types}
    rows = []
    for position in np.flatnonzero(report.faulty).tolist():
        of_type = types[int(structure.sensor_type[position])]
        numbers = {field.name: getattr(report, field.name)[position].item() for field in fields(report)}
        named = {"name": structure.sensor_name(position), "uid": int(source.uid[position]), "type": of_type.name}
        other = structure.sensor_name(numbers["other"]) if numbers["other"] >= 0 else ""
        evidence = report.evidence(position, of_type.unit, other)
        judged = {"kind": HealthKind(numbers["kind"]).name.lower(), "evidence": evidence}
        rows.append({**named, **numbers, **judged})
    return rows
