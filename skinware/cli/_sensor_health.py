"""What is known of the health of sensors, as ``skin-info --health`` shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from skinware.cli._format import age_text, count_text, plural, table, terminal_width, wrapped
from skinware.cli._terminal import echo, print_json, style
from skinware.driver_service import DriverReader
from skinware.errors import BadServiceFile, Overrun, ServiceNotFound, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.service import ServiceReader
from skinware.tactile.health_report import HealthKind, HealthReport
from skinware.tactile.health_service import KIND, HealthReader, HealthSample
from skinware.views.health import life_of

_NOTHING = """\
Nobody looks after the health of sensors here. For a driver NAME:
  skin-calm NAME    (beside which it is published, in the namespace calm)"""
_FAULT_COLOUR = "yellow"


def show(namespaces: Sequence[Namespace], driver: str | None, as_json: bool) -> None:
    """Print it: see :func:`health`.

    Raises:
        ServiceNotFound: no service reports the health of that driver.
    """
    found = health(namespaces, driver)
    if driver is not None and not (found["health"] or found["problems"]):
        raise ServiceNotFound(f"no service reports the health of driver {driver!r}; start one: skin-calm {driver}")
    if as_json:
        print_json(found)
    else:
        echo("\n".join(part for line in as_text(found) for part in wrapped(line, terminal_width())))


def health(namespaces: Sequence[Namespace], driver: str | None) -> dict[str, Any]:
    """The health of all sensors that somebody looks after, as ``skin-info --health --json`` prints it.

    Args:
        namespaces: where to look.
        driver: name of the one driver to look at.

    Raises:
        NamespaceError: a namespace cannot be trusted or read.
    """
    entries: list[dict[str, Any]] = []
    problems: list[str] = []
    for namespace in namespaces:
        for name in namespace.services():
            try:
                entry = _entry(namespace, name, driver)
            except ServiceNotFound:
                continue  # it was withdrawn this very moment
            except BadServiceFile as error:
                problems.append(str(error))
                continue
            entries += [entry] if entry is not None else []
    return {"health": entries, "problems": problems}


def as_text(found: dict[str, Any]) -> list[str]:
    lines: list[str] = []
    for entry in found["health"]:
        counts = {name.replace("_", " "): count for name, count in entry["kinds"].items() if count}
        told = ", ".join(f"{count_text(count)} {name}" for name, count in counts.items())
        name = style(entry["driver"], bold=True)
        age = "" if entry["state"] == "live" else f" ({entry['state']}, as of {age_text(entry['age_ms'] * 1e6)} ago)"
        lines += [f"{name} in namespace {entry['namespace']}: {plural(entry['sensors'], 'sensor')}: {told}{age}"]
        rows = [(fault["name"], fault["type"], fault["kind"], fault["evidence"]) for fault in entry["faults"]]
        head, *body = table(("sensor", "type", "fault", "evidence"), rows, left=4)
        lines += [f"  {head}", *(style(f"  {line}", fg=_FAULT_COLOUR) for line in body)] if rows else []
        lines += [""]
    lines = lines[:-1] or [_NOTHING]
    return lines + [style("problem: ", fg="red") + text for text in found["problems"]]


def _entry(namespace: Namespace, name: str, driver: str | None) -> dict[str, Any] | None:
    """What one service tells; None: it is none of health, of another driver, or has told nothing yet."""
    with ServiceReader[Any](name, namespace=namespace, announce=False) as service:
        if service.kind != KIND:
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
    told: dict[str, Any] = {"driver": source.driver, "namespace": namespace.name, "service": name, "state": state}
    told |= {"age_ms": round(frame.age_ns / 1e6, 3), "sensors": len(known)}
    return told | {"kinds": kinds, "faults": _faults(namespace, frame, report)}


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
        judged = {"kind": HealthKind(numbers["kind"]).name.lower(), "evidence": report.evidence(position, of_type.unit)}
        rows.append({**named, **numbers, **judged})
    return rows
