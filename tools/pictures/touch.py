"""The pictures of docs/tactile: what each part of skinware.tactile makes of a skin whose truth is known.

Usage: python tools/pictures/touch.py FOLDER        (writes NAME.svg there, for each NAME in PICTURES)
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware import Structure
from skinware.sensor_types import MAGNETIC_FIELD, PRESSURE, TEMPERATURE
from skinware.tactile import Baseline, Box, Contacts, Health, HealthKind, HealthSettings, Region, Regions
from skinware.tactile.calibration.placing import Presses, place
from skinware.tactile.calibration.shapes import shapes_of
from skinware.tactile.chain import BaselineStageSettings
from skinware.tactile.motion import motion_of
from skinware.tactile.neighbours import neighbours
from skinware.tactile.stages import Signal, Taxels
from skinware.tactile.testing import Response, World, arm, grid, triangles
from skinware.tactile.thermal import ThermalStage
from skinware.tactile.vectors import FieldSettings, VectorSettings

ArrayF = npt.NDArray[np.float64]

_WIDTH = 860
_INK, _GREY, _PALE = "#1f2933", "#94a3b8", "#e5e9f0"
_GREEN, _BLUE, _RED, _AMBER = "#15803d", "#1d4ed8", "#b91c1c", "#d97706"
_THRESHOLD = 8
"""Of a touch, for whoever tares once."""


def baseline_picture() -> str:
    """One taxel over four minutes of drift, touched twice: counts, baseline, and when it is shown as touched."""
    world = World(grid(modules=4), seed=4, drift_per_min=6, wave=4, wave_s=150, response=Response(remainder=0.1))
    taxel = 5
    world.push(world.surface.position_m[taxel], 25, 60, 140)
    world.push(world.surface.position_m[taxel], 12, 190, 193, rise_s=0.2)
    block = world.record(240)
    baseline = Baseline(world.surface.module, world.surface.patch)
    calm = [baseline.update(sample.time_ns, sample.values, sample.usable) for sample in block]
    counts = block.values[:, taxel].astype(float)
    rows = slice(None, None, 10)
    time_s = np.arange(len(block))[rows] / world.rate_hz
    base = np.array([one.baseline[taxel] for one in calm])[rows]
    shown = np.array([one.touched[taxel] for one in calm])
    tared = counts - counts[: round(5 * world.rate_hz)].mean() > _THRESHOLD
    truth = block.truth[:, taxel] > 1

    left, right, top, height = 60, 20, 30, 230
    low, high = 0.0, 60.0

    def x(at_s: float | ArrayF) -> ArrayF:
        return left + (_WIDTH - left - right) * np.asarray(at_s) / 240

    def y(value: float | ArrayF) -> ArrayF:
        return top + height * (1 - (np.asarray(value) - low) / (high - low))

    parts = [_text(left, top - 10, "counts of one taxel, and its baseline", bold=True)]
    for value in range(0, 61, 20):
        parts.append(_line([left, _WIDTH - right], [float(y(value))] * 2, _PALE))
        parts.append(_text(left - 8, float(y(value)) + 5, str(value), anchor="end"))
    parts.append(_line(x(time_s), y(counts[rows]), _GREY))
    known = np.isfinite(base)
    parts.append(_line(x(time_s[known]), y(base[known]), _GREEN, width=2.5))
    bars = (
        ("touched, in truth", truth, _INK),
        ("shown: the baseline", shown, _GREEN),
        ("shown: 8 counts above a tare", tared, _RED),
    )
    bar_y = top + height + 34
    for name, flags, colour in bars:
        parts.append(_text(left, bar_y, name))
        for begin, end in _runs(flags):
            from_x, to_x = float(x(begin / world.rate_hz)), float(x(end / world.rate_hz))
            size = f'width="{max(to_x - from_x, 1):.1f}" height="8"'
            parts.append(f'<rect x="{from_x:.1f}" y="{bar_y + 6}" {size} fill="{colour}"/>')
        parts.append(_line([left, _WIDTH - right], [bar_y + 14] * 2, _PALE))
        bar_y += 36
    parts += [
        _text(float(x(60 * minute)), bar_y, f"{minute} min", anchor="middle" if minute < 4 else "end")
        for minute in range(5)
    ]
    return _svg("A taxel that drifts while it is touched twice", bar_y + 14, parts)


def contacts_picture() -> str:
    """Two fingers on the arm: what each taxel showed at most, and the ways of the contacts."""
    surface = arm()
    world = World(surface, seed=2, drift_per_min=1)
    world.stroke([(0.015, 0.0, 0.0225), (0.12, 0.004, 0.0225)], 60, 8, 13, radius_m=0.005)
    world.stroke([(0.22, -0.012, 0.0125), (0.17, 0.012, 0.0125)], 60, 9, 13, radius_m=0.005)
    places = surface.geometry("arm")
    baseline, contacts = Baseline(surface.module, surface.patch), Contacts(len(places), neighbours(places), places)
    peak = np.zeros(len(surface))
    ways: dict[int, list[tuple[float, float, float]]] = {}
    for sample in world.record(14):
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
        np.maximum(peak, calm.value, out=peak)
        for contact in contacts.update(calm.value, calm.touched, sample.time_ns):
            at_x, at_y, _ = contact.cop_m.tolist()
            ways.setdefault(contact.id, []).append((at_x, at_y, contact.load))
    above = surface.normal[:, 2] > 0.4
    colours = [_shade(value / peak.max()) for value in peak]
    parts, height = _taxels(surface.position_m, above, colours)
    loads = {number: max(load for _, _, load in way) for number, way in ways.items()}
    for number, way in ways.items():
        load = loads[number]
        if load < max(loads.values()) / 10:
            continue  # a taxel that was let go a moment later than its neighbours
        at = _on_page(np.array([[at_x, at_y] for at_x, at_y, now in way if now > load / 10]))
        parts.append(_line(at[:, 0], at[:, 1], _RED, width=2))
        last_x, last_y = at[-1].tolist()
        parts.append(f'<circle cx="{last_x:.1f}" cy="{last_y:.1f}" r="5" fill="{_RED}"/>')
        parts.append(_text(last_x + 10, last_y - 8, f"{number}: {load:.0f} counts", colour=_RED, bold=True))
    return _svg("Contacts of two fingers on an arm, seen from above", height, parts)


def thermal_picture() -> str:
    """A taxel of a patch that is gripped whole while it warms and cools: shown without and with temperatures."""
    random, rate_hz, n, pads = np.random.default_rng(3), 10, 80, 16
    module, of_pad, patch = np.arange(n) // 10, np.arange(pads) // 2, np.zeros(n, np.int64)
    pressure, temperature = (of.measured(unit="counts", minimum=0.0, maximum=255.0) for of in (PRESSURE, TEMPERATURE))
    uid = np.arange(n, dtype=np.uint64)
    stage = ThermalStage(
        Taxels(pressure, uid, module, patch, 1.0),
        Taxels(temperature, uid[:pads] + n, of_pad, patch[:pads], 1.0),
        spread=1.0,
    )
    with_stage, without = Baseline(module, patch), Baseline(module, patch)
    time_s = np.arange(900 * rate_hz) / rate_hz
    warm = 8 * np.sin(time_s * 2 * np.pi / 400)
    truth = 20.0 * ((time_s > 200) & (time_s < 800))
    follows = (1 + 0.3 * random.standard_normal(n)).clip(0.2, 3)
    shown = np.zeros((2, len(time_s)))
    for row, (warmth, load) in enumerate(zip(warm, truth, strict=True)):
        values = np.round(60 + follows * warmth + load + 0.8 * random.standard_normal(n))
        signal = Signal.of(row * 10**9 // rate_hz, values)
        felt = Signal.of(signal.time_ns, np.round(100 + 3 * warmth + 0.4 * random.standard_normal(pads)))
        shown[0, row] = without.update(signal.time_ns, values).value[0]
        stage.step(signal, felt)
        shown[1, row] = with_stage.update(signal.time_ns, signal.values).value[0]
    lines = [("temperature (counts of a pad / 3)", warm, _AMBER), ("load, in truth", truth, _INK)]
    lines += [("shown without", shown[0], _RED), ("shown with the stage thermal", shown[1], _GREEN)]
    return _chart("A patch that is gripped whole while it warms and cools", time_s, lines, (-10.0, 30.0), "counts")


def turning_picture() -> str:
    """A magnetometer of a finger that turns and is pressed: as it is, and behind the stages."""
    random, rate_hz, n = np.random.default_rng(5), 50, 5
    axes = [
        Taxels(of.measured(unit="uT"), np.arange(n, dtype=np.uint64), *np.zeros((2, n), int)) for of in MAGNETIC_FIELD
    ]
    field = FieldSettings().stage(*axes)
    stages = [BaselineStageSettings().stage(one) for one in field.axes]
    vector = VectorSettings().stage(*(stage.taxels for stage in stages))
    time_s = np.arange(40 * rate_hz) / rate_hz
    angle = 1.3 * time_s + np.sin(time_s / 2)
    turned = 50 * np.array([np.cos(angle), np.sin(angle) * np.cos(time_s / 7), np.sin(angle) * np.sin(time_s / 7)])
    pressed = 80 * np.interp(time_s % 12, [0, 4, 4.2, 7, 7.2, 12], [0, 0, 1, 1, 0, 0]) * (time_s > 12)
    response = np.eye(3) + 0.05 * random.standard_normal((n, 3, 3))
    raw, shown = np.zeros((2, len(time_s)))
    for row, load in enumerate(pressed):
        values = response @ turned[:, row] + 0.5 * random.standard_normal((n, 3))
        values[0, 2] += load
        raw[row] = np.linalg.norm(values[0] - response[0] @ turned[:, 0])
        signals = [Signal.of(row * 10**9 // rate_hz, axis) for axis in values.T]
        field.step(*signals)
        for stage, signal in zip(stages, signals, strict=True):
            stage.step(signal)
        vector.step(*signals)
        shown[row] = np.linalg.norm([signal.values[0] for signal in signals])
    lines = [("change of the field since the start", raw, _GREY), ("press, in truth", pressed, _INK)]
    lines.append(("length of the vector that is shown", shown, _GREEN))
    return _chart("A magnetometer of a finger that turns", time_s, lines, (0.0, 160.0), "µT")


def regions_picture() -> str:
    """The arm with two regions, seen from above."""
    surface = arm()
    n = len(surface)
    structure = Structure(
        types=[PRESSURE.measured(unit="counts")],
        buses=["can0"],
        patch_name=["board 7", "board 8", "board 9", "board 10"],
        patch_bus=[0] * 4,
        module_patch=np.arange(surface.n_modules) // 16,
        module_kind=["triangle"] * surface.n_modules,
        sensor_uid=np.arange(n),
        sensor_type=[PRESSURE.id] * n,
        sensor_module=surface.module,
        dtype="u1",
    ).placed(surface.geometry("arm"))
    box = Box(frame="arm", centre_m=(0.115, 0.0, 0.0), size_m=(0.05, 0.1, 0.1))
    regions = Regions([Region("wrist", box=(box,)), Region("hand", patch=("board 10",))])
    colour_of = {"wrist": _AMBER, "hand": _BLUE}
    colours = np.full(n, _PALE, object)
    for name, index in regions.of(structure, "pressure").items():
        colours[index] = colour_of[name]
    parts, height = _taxels(surface.position_m, surface.normal[:, 2] > 0.4, colours.tolist())
    words = {"wrist": 'box = [{ frame = "arm", ... }]', "hand": 'patch = ["board 10"]'}
    for number, (name, colour) in enumerate(colour_of.items()):
        parts.append(_text(40 + 330 * number, 24, f"{name}: {words[name]}", colour=colour, bold=True))
    return _svg("Two regions of an arm, seen from above", height, parts)


def health_picture() -> str:
    """The arm after a minute of strokes, with five broken taxels: what each taxel showed of its due, and the faults."""
    surface = arm()
    world = World(surface, seed=3, rate_hz=20, gain_spread=0.15)
    lines = [((0.0, y, 0.0225), (0.15, y, 0.0225)) for y in np.linspace(-0.012, 0.012, 5)]
    lines += [((0.165, y, 0.0125), (0.23, y, 0.0125)) for y in np.linspace(-0.024, 0.024, 7)]
    for number in range(6 * len(lines)):
        world.stroke(lines[number % len(lines)], 60, 7 + 1.2 * number, 8 + 1.2 * number, radius_m=0.006)
    places = surface.geometry("arm")
    wanted_m = [(0.03, 0.011), (0.075, -0.011), (0.115, 0.011), (0.185, 0.012), (0.205, -0.012)]
    above = surface.normal[:, 2] > 0.8
    away_m = [np.where(above, np.hypot(*(surface.position_m[:, :2] - place).T), np.inf) for place in wanted_m]
    dead, weak, noisy, stuck, clipped = (int(np.argmin(of)) for of in away_m)
    world.dead([dead])
    world.gain[weak] = 0.12
    world.noisy([noisy], 8)
    world.stuck([stuck], 73)
    world.jump([clipped], 300, at_s=-1)
    baseline = Baseline(surface.module, surface.patch)
    health = Health(surface.module, places, HealthSettings(stuck_s=40), limits=(0, 255))
    for sample in world.record(7 + 1.2 * 6 * len(lines) + 5):
        values = sample.values.astype(np.float32)
        health.update(sample.time_ns, values, baseline.update(sample.time_ns, values, sample.usable))
    report = health.report()
    shown = np.nan_to_num(report.shown)
    seen = surface.normal[:, 2] > 0.4
    parts, height = _taxels(surface.position_m, seen, [_shade(share) for share in shown])
    at = _on_page(surface.position_m[:, :2])
    for taxel in np.flatnonzero(report.faulty & seen).tolist():
        x, y = at[taxel].tolist()
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="9" fill="none" stroke="{_RED}" stroke-width="3"/>')
        parts.append(_text(x + 12, y - 10, HealthKind(report.kind[taxel]).name.lower(), colour=_RED, bold=True))
    return _svg("Five broken taxels of an arm that was stroked for a minute, seen from above", height, parts)


def motion_picture() -> str:
    """A finger that strokes to and fro, faster each time: the velocity of the region along x, told and in truth."""
    surface = grid(rows=6, columns=30)
    (low_m, low_y_m), (high_m, high_y_m) = surface.position_m.min(axis=0)[:2], surface.position_m.max(axis=0)[:2]
    ways = [(low_m, high_m), (high_m, low_m)]
    world = World(surface, seed=5, drift_per_min=1)
    strokes, begin_s = [], 7.0
    for number, speed_m_s in enumerate((0.02, 0.04, 0.08)):
        ends = [(at, (low_y_m + high_y_m) / 2, 0.0) for at in ways[number % 2]]
        end_s = begin_s + (high_m - low_m) / speed_m_s
        world.stroke(ends, 60, begin_s, end_s, radius_m=0.005)
        strokes.append((begin_s, end_s, speed_m_s * (-1) ** number))
        begin_s = end_s + 1.5
    until_s = begin_s
    places = surface.geometry("arm")
    baseline, contacts = Baseline(surface.module, surface.patch), Contacts(len(places), neighbours(places), places)
    told = []
    for sample in world.record(until_s):
        calm = baseline.update(sample.time_ns, sample.values, sample.usable)
        found = contacts.update(calm.value, calm.touched, sample.time_ns)
        told.append(motion_of({"all": slice(None)}, found, calm.value).velocity_m_s[0, 0])
    time_s, velocity = np.arange(len(told)) / world.rate_hz, 1e3 * np.array(told)
    left, right, top, height, from_s = 60, 20, 30, 260, 6.0

    def x(at_s: float | ArrayF) -> ArrayF:
        return left + (_WIDTH - left - right) * (np.asarray(at_s) - from_s) / (until_s - from_s)

    def y(value: float | ArrayF) -> ArrayF:
        return top + height * (120 - np.asarray(value)) / 280

    parts = [_text(left, top - 10, "velocity of a region along its length, mm/s", bold=True)]
    for value in range(-160, 121, 40):
        parts.append(_line([left, _WIDTH - right], [float(y(value))] * 2, _PALE))
        parts.append(_text(left - 8, float(y(value)) + 5, str(value), anchor="end"))
    for first_s, last_s, speed_m_s in strokes:
        parts.append(_line(x(np.array([first_s, last_s])), y(np.full(2, 1e3 * speed_m_s)), _GREY, width=3))
    for first, last in _runs(np.isfinite(velocity) & (time_s > from_s)):
        parts.append(_line(x(time_s[first:last]), y(velocity[first:last]), _GREEN, width=2))
    parts.append(_text(_WIDTH - right, top + 14, "grey: the finger; green: what is told", anchor="end"))
    bottom = top + height + 20
    parts += [_text(float(x(second)), bottom, f"{second} s", anchor="middle") for second in range(8, int(until_s), 2)]
    return _svg("The motion of a region while a finger strokes it", bottom + 14, parts)


def calibration_picture() -> str:
    """Triangles whose taxels were pressed five times each, by points good to 2 mm: true places and those found."""
    surface = triangles(modules=7)
    random = np.random.default_rng(3)
    taxel = np.repeat(np.arange(len(surface)), 5)
    away = random.uniform(-0.004, 0.004, (len(taxel), 3)) * (1, 1, 0)
    true_m = surface.position_m[taxel] + away
    distance_m = np.linalg.norm(true_m[:, None] - surface.position_m, axis=2)
    load = np.rint(80 * np.exp(-0.5 * (distance_m / 0.004) ** 2) + random.normal(0, 1.5, distance_m.shape))
    presses = Presses.of_arrays(true_m + random.normal(0, 0.002, true_m.shape), np.where(load < 8, 0, load))
    layout = shapes_of(surface.module, ["triangle"] * surface.n_modules, surface.position_m, surface.normal)
    ways = {
        "each taxel by itself": (place(presses), _AMBER),
        "with the layout of modules": (place(presses, layout), _BLUE),
    }
    origin_m = surface.position_m[:, :2].min(axis=0)
    scale, left, top = 5600.0, 60, 70
    parts = []

    def at(position_m: ArrayF) -> ArrayF:
        return np.asarray(scale * (position_m[:, :2] - origin_m) + (left, top))

    true = at(surface.position_m)
    for x, y in true.tolist():
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="9" fill="none" stroke="{_GREY}" stroke-width="2"/>')
    words_x = 40.0
    for name, (placement, colour) in ways.items():
        off_mm = 1e3 * np.linalg.norm(placement.position_m - surface.position_m, axis=1)
        parts.append(_text(words_x, 30, f"{name}: off by {np.nanmean(off_mm):.1f} mm", colour=colour, bold=True))
        words_x += 320
        for (x, y), (true_x, true_y) in zip(at(placement.position_m).tolist(), true.tolist(), strict=True):
            parts.append(_line([true_x, x], [true_y, y], colour))
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>')
    parts.append(_text(_WIDTH - 30, 30, "circles: the truth", anchor="end"))
    return _svg("Places of taxels from presses, and the truth", float(true[:, 1].max()) + 40, parts)


def _on_page(xy_m: ArrayF) -> ArrayF:
    """(m, 2) where places of the arm are on the page, px."""
    scale, middle = 3300.0, 135.0
    return np.column_stack([40 + scale * xy_m[:, 0], middle - scale * xy_m[:, 1]])


def _taxels(position_m: ArrayF, seen: npt.NDArray[np.bool_], colours: Sequence[str]) -> tuple[list[str], int]:
    """Circles for the taxels that are seen, and the height of the page."""
    at = _on_page(position_m[:, :2])
    circles = [
        f'<circle cx="{at[taxel, 0]:.1f}" cy="{at[taxel, 1]:.1f}" r="7" fill="{colours[taxel]}" stroke="{_GREY}"/>'
        for taxel in np.flatnonzero(seen).tolist()
    ]
    return circles, 260


def _shade(part: float) -> str:
    """From pale to green."""
    pale, green = (np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) for colour in (_PALE, "#22c55e"))
    red, green_, blue = (pale + (green - pale) * min(max(part, 0.0), 1.0)).round().astype(int).tolist()
    return f"#{red:02x}{green_:02x}{blue:02x}"


def _chart(
    title: str, time_s: ArrayF, lines: Sequence[tuple[str, ArrayF, str]], limits: tuple[float, float], unit: str
) -> str:
    """Lines over time, each with its name and colour, with a scale of the unit at the left."""
    left, right, top, height, (low, high) = 60, 20, 30, 200, limits
    x = left + (_WIDTH - left - right) * time_s / time_s[-1]
    parts = [_text(left, top - 10, unit, bold=True)]
    for value in np.linspace(low, high, 5):
        at_y = top + height * (high - value) / (high - low)
        parts += [
            _line([left, _WIDTH - right], [at_y] * 2, _PALE),
            _text(left - 8, at_y + 5, f"{value:g}", anchor="end"),
        ]
    rows = slice(None, None, max(len(time_s) // 700, 1))
    for number, (name, values, colour) in enumerate(lines):
        parts.append(_line(x[rows], top + height * (high - values[rows]) / (high - low), colour, width=1.5))
        parts.append(
            _text(left + (number % 2) * 400, top + height + 48 + number // 2 * 22, name, colour=colour, bold=True)
        )
    parts += [
        _text(
            float(left + (_WIDTH - left - right) * part),
            top + height + 20,
            f"{part * time_s[-1]:.0f} s",
            anchor="middle",
        )
        for part in (0.0, 0.25, 0.5, 0.75, 0.98)
    ]
    return _svg(title, top + height + 62 + (len(lines) - 1) // 2 * 22, parts)


def _runs(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begin and end of every stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def _line(x: Sequence[float] | ArrayF, y: Sequence[float] | ArrayF, colour: str, width: float = 1) -> str:
    points = " ".join(f"{at_x:.1f},{at_y:.1f}" for at_x, at_y in zip(np.asarray(x), np.asarray(y), strict=True))
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width}"/>'


def _text(x: float, y: float, words: str, *, colour: str = _INK, bold: bool = False, anchor: str = "start") -> str:
    weight = ' font-weight="bold"' if bold else ""
    escaped = words.replace("&", "&amp;").replace("<", "&lt;")
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}"{weight}>{escaped}</text>'


def _svg(title: str, height: float, parts: Sequence[str]) -> str:
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height:g}" font-family="sans-serif"'
        f' font-size="14" role="img">\n<title>{title}</title>\n'
        f'<rect width="{_WIDTH}" height="{height:g}" rx="8" fill="#ffffff"/>\n'
    )
    return head + "\n".join(parts) + "\n</svg>\n"


PICTURES = {
    "baseline": baseline_picture,
    "contacts": contacts_picture,
    "regions": regions_picture,
    "health": health_picture,
    "motion": motion_picture,
    "calibration": calibration_picture,
    "thermal": thermal_picture,
    "turning": turning_picture,
}

if __name__ == "__main__":
    for name, picture in PICTURES.items():
        (Path(sys.argv[1]) / f"{name}.svg").write_text(picture(), encoding="utf-8")
