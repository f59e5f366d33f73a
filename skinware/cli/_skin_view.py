"""From frames to what a terminal shows: pure functions, no terminal needed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from skinware.status import PatchState, Status

if TYPE_CHECKING:
    from rich.text import Text

    from skinware.driver_service import DriverFrame, DriverReader
    from skinware.sensor_types import SensorType

LEVELS = 9
_COLOURS = ("#16213e", "#1b3a6b", "#1f5f99", "#1f8aa8", "#2fb38a", "#86c95a", "#d7c94a", "#ee8f3a", "#e5483a")
"""One colour per level, from no touch to full scale."""
_DIM = "#3a3a3a"


def driver_line(reader: DriverReader, frame: DriverFrame) -> str:
    """One driver on one line."""
    status = frame.status
    states = [PatchState(state).name.lower() for state in frame.patch_state.tolist()]
    patches = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    fresh, stale = int((status == 0).sum()), int(((status & (Status.STALE | Status.NEVER_SEEN)) != 0).sum())
    orphans = sum(counters.get("orphans", 0) for counters in reader.patch_counters(frame))
    lost = sum(counters.get("lost", 0) for counters in reader.bus_counters(frame))
    rate = reader.rate_hz()
    life = "" if reader.alive else "  DEAD"
    return (
        f"{reader.name}  {f'{rate:.1f}' if rate else '?'} Hz  age {frame.age_ns / 1e6:.0f} ms"
        f"  sensors {len(status)} (fresh {fresh}, stale {stale})  patches {patches}"
        f"  lost {lost}  orphans {orphans}{life}"
    )


def patch_rows(reader: DriverReader, frame: DriverFrame) -> list[tuple[str, ...]]:
    """A row per patch: bus, name, state, age, fresh sensors, orphans, updates."""
    structure = frame.structure
    newest = np.zeros(structure.n_patches, np.int64)
    np.maximum.at(newest, structure.module_patch, frame.module_time_ns)
    rows: list[tuple[str, ...]] = []
    for patch, counters in enumerate(reader.patch_counters(frame)):
        status = frame.status[structure.patch_index(patch)]
        age_ms = (frame.age_ns + frame.acquired_ns - int(newest[patch])) / 1e6
        rows.append(
            (
                str(structure.buses[structure.patch_bus[patch]]),
                bytes(structure.patch_name[patch]).decode(),
                PatchState(frame.patch_state[patch]).name.lower(),
                f"{age_ms:.0f}" if newest[patch] else "-",
                f"{int((status == 0).sum())}/{len(status)}",
                str(counters.get("orphans", "")),
                str(counters.get("updates", "")),
            )
        )
    return rows


def levels(values: npt.NDArray[np.float32], sensor_type: SensorType) -> npt.NDArray[np.int64]:
    """(n,) int64 level, 0 to 8, of physical values within the type's range, or within their own without one."""
    low, high = sensor_type.minimum, sensor_type.maximum
    if not np.isfinite(low) or not np.isfinite(high) or low >= high:
        low, high = float(values.min(initial=0)), float(values.max(initial=1))
    scaled = (np.nan_to_num(values) - low) / max(high - low, 1e-9) * LEVELS
    level: npt.NDArray[np.int64] = np.clip(scaled, 0, LEVELS - 1).astype(np.int64)
    return level


def heat_map(frame: DriverFrame, patch: int, type_name: str) -> Text:
    """The sensors of one type of a patch: a row per module, two cells a sensor.

    Fresh sensors are coloured by value; ``x`` is not connected, ``!`` out of range, ``?`` suspect, ``.`` stale or
    never seen.
    """
    from rich.text import Text

    structure = frame.structure
    sensor_type = structure.type(type_name)
    physical = frame.values.astype(np.float32) * np.float32(sensor_type.scale) + np.float32(sensor_type.offset)
    level = levels(physical, sensor_type)
    text = Text()
    for module in np.flatnonzero(structure.module_patch == patch).tolist():
        kind = bytes(structure.module_kind[module]).decode()
        text.append(f"{module:>5} {kind:<10.10} ")
        positions = np.arange(structure.n_sensors)[structure.module_index(module)]
        for sensor in positions[structure.sensor_type[positions] == sensor_type.id].tolist():
            mark = status_mark(int(frame.status[sensor]))
            colour = _DIM if mark in ".x" and mark else _COLOURS[int(level[sensor])]
            text.append(f"{mark or ' '} ", style=f"white on {colour}")
        text.append("\n")
    return text


def status_mark(status: int) -> str:
    """One character for a sensor that is not simply fresh; empty if it is."""
    if status & (Status.NEVER_SEEN | Status.STALE | Status.MASKED):
        return "."
    if status & (Status.NOT_CONNECTED | Status.NO_ACK):
        return "x"
    if status & Status.OUT_OF_RANGE:
        return "!"
    return "?" if status & Status.SUSPECT else ""
