"""Print the events of ``skin-driver``: lines for people, or one JSON object per event."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from skinware.cli._terminal import echo, print_json
from skinware.text import plural

if TYPE_CHECKING:
    from skinware_drivers.cli.capturing import Capture
    from skinware_drivers.running.news import PatchChange
    from skinware_drivers.running.runner import Runner


def print_ready(runner: Runner, as_json: bool) -> None:
    if runner.builder.generation is None:
        return
    structure = runner.builder.generation.tables.structure
    buses = [line.name for line in runner.lines]
    if as_json:
        types = {t.name: int((structure.sensor_type == t.id).sum()) for t in structure.types}
        counts = {"sensors": structure.n_sensors, "modules": structure.n_modules, "patches": structure.n_patches}
        identity = {"driver": runner.identity.driver_type, "name": runner.identity.name}
        ready: dict[str, Any] = {"event": "ready", **identity, **counts}
        latency_ms = int(runner.builder.generation.publisher.latency_ns[0]) / 1e6
        print_json({**ready, "types": types, "buses": buses, "latency_ms": latency_ms})
    else:
        patches, modules = plural(structure.n_patches, "patch", "patches"), plural(structure.n_modules, "module")
        what = f"{patches}, {modules}, {plural(structure.n_sensors, 'sensor')} on {', '.join(buses)}"
        echo(f"{runner.identity.name}: {what}; publishing (skin-top shows it, Ctrl-C ends)")


def print_patches(runner: Runner, change: PatchChange) -> None:
    """Print for programs that patches fell silent, or are live again; people see it in the log."""
    if runner.ready:
        print_json({"event": "patches", "name": runner.identity.name, **change._asdict()})


def print_capture(capture: Capture, as_json: bool) -> None:
    """Print that the captured file is complete, or why it is not."""
    with contextlib.suppress(BrokenPipeError):
        if as_json:
            print_json({"event": "captured", "file": str(capture.path), **capture.result})
        elif capture.result["problem"]:
            echo(f"{capture.path}: ended early: {capture.result['problem']}", err=True)
        else:
            missed = f", {capture.result['missed']} frames missed" if capture.result["missed"] else ""
            size = capture.result["bytes"] / 1e6
            echo(f"{capture.path}: {size:.1f} MB{missed}; skin-driver --bus replay:{capture.path} decodes it again")


async def report(runner: Runner) -> None:
    """Print its state each second, for programs, until the pipe is closed."""
    while True:
        await asyncio.sleep(1)
        if runner.ready:
            try:
                print_json({"event": "status", "name": runner.identity.name, **runner.status()})
            except BrokenPipeError:
                runner.stop()
                return
