"""Gather presses or strokes for skin-calibrate; read its layouts, write its places, and show what it found."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt

from skinware.cli import _command as cli
from skinware.cli._heat_map import BACKGROUND, arrange
from skinware.cli._terminal import are_terminals, echo, enter_pressed, print_json, say, terminal_width
from skinware.driver_service import DriverReader
from skinware.errors import ConfigurationError
from skinware.geometry import Geometry, geometry_to_toml, read_geometry
from skinware.memory.namespace import Namespace
from skinware.service import ServiceReader
from skinware.structure import Structure
from skinware.tactile.calibration.checking import MIRRORED, OFF, SHARED, SWAPPED, TURNED, UNKNOWN, Finding
from skinware.tactile.calibration.placing import Placement
from skinware.tactile.calibration.results import placed_comment, placed_groups
from skinware.tactile.calibration.shapes import Shape, shapes_of
from skinware.tactile.calibration.sources import ForceSource, LoadSource, PoseSource
from skinware.tactile.calibration.state import Session, restore_session, save_session
from skinware.text import plural
from skinware.views.live import after, frames_until, reader_of

SIGNS = "·▂▃▄▅▆▇█"
"""Signs of sensors from nothing to all that is wanted."""
_BAR = 20
_HEIGHT = 40


def bars(structure: Structure, type_name: str, coverage: npt.NDArray[np.float64]) -> Iterator[str]:
    """Yield a line for each patch: its name, a bar, and how many of its sensors have all that is wanted."""
    patch = structure.patch_of(type_name)
    width = max(map(len, structure.patch_names))
    for number, name in enumerate(structure.patch_names):
        own = coverage[patch == number]
        if len(own):
            full = "█" * round(_BAR * float(own.mean()))
            yield f"{name:<{width}}  {full:░<{_BAR}}  {int((own >= 1).sum())} of {len(own)}"


def picture(structure: Structure, type_name: str, coverage: npt.NDArray[np.float64], width: int) -> Iterator[str]:
    """Yield lines with the sensors, module by module as in ``skin-top``, each as the sign of its coverage, 0 to 1."""
    drawn = arrange(structure, list(range(structure.n_patches)), type_name, width, _HEIGHT, smallest=2)
    of_sensor = np.zeros(structure.n_sensors)
    of_sensor[structure.index(type_name)] = coverage
    level = np.where(of_sensor >= 1, len(SIGNS) - 1, np.ceil(of_sensor * (len(SIGNS) - 2)))
    pixels = drawn.draw(level.astype(np.uint8)[drawn.sensors])
    for number in range(drawn.lines):
        upper, lower = pixels[2 * number : 2 * number + 2]
        codes = np.where(upper == BACKGROUND, lower, upper).tolist()
        signs = [" " if code == BACKGROUND else SIGNS[code] for code in codes]
        for label in drawn.labels.get(number, ()):
            signs[label.column : label.column + len(label.text)] = label.text
        yield "".join(signs).rstrip()


def finding_data(finding: Finding, structure: Structure, type_name: str) -> dict[str, Any]:
    return {
        "kind": finding.kind,
        "modules": [structure.module_names[number] for number in finding.modules],
        "patches": [structure.patch_names[number] for number in finding.patches],
        "uid": structure.sensor_uid[_sensors(finding, structure, type_name)].tolist(),
        "off_m": finding.off_m,
        "degrees": finding.degrees,
    }


def finding_text(finding: Finding, structure: Structure, type_name: str) -> str:
    """Return a finding for people in one line; arguments as of :func:`finding_data`."""
    found = finding_data(finding, structure, type_name)
    names = found["modules"] or found["patches"]
    count, whose = plural(len(finding.taxels), "sensor"), ", ".join(names)
    sensor = structure.sensor_name(int(_sensors(finding, structure, type_name)[0]))
    text = {
        SHARED: f"{count} of {whose} at places of others",
        UNKNOWN: f"{count} of {whose} without a place",
        SWAPPED: f"{' and '.join(names)} are at each other's places: exchanged connectors?",
        MIRRORED: f"{whose}: its mirror image would fit",
        TURNED: f"{whose}: turned by {finding.degrees:.0f} degrees it would fit",
        OFF: f"{sensor} is {1e3 * finding.off_m:.0f} mm from where its neighbours are",
    }[finding.kind]
    return f"{finding.kind}: {text}"


def _sensors(finding: Finding, structure: Structure, type_name: str) -> npt.NDArray[np.int64]:
    sensors: npt.NDArray[np.int64] = structure.index(type_name)[finding.taxels]
    return sensors


_POSES_TIMEOUT_S = 5.0
_REPORT_EVERY_S = 1.0
_SAVE_EVERY_S = 10.0
_WIDTH = 100


@dataclass(frozen=True)
class GatheringOptions:
    driver: str | None
    type_name: str | None
    share: float
    duration_s: float | None
    state: Path | None
    namespace: str | None
    as_json: bool


class Gathering:
    def __init__(
        self,
        reader: DriverReader,
        session: Session,
        source: LoadSource,
        poses: PoseSource | ForceSource | None,
        state_path: Path,
        *,
        as_json: bool,
    ) -> None:
        self._reader, self._session, self.source, self.poses = reader, session, source, poses
        self._state_path, self._as_json = state_path, as_json
        self.structure: Structure = reader.structure
        self.type_name: str = source.type_name
        self._uid: npt.NDArray[np.uint64] = reader.structure.sensor_uid[reader.structure.index(source.type_name)]
        self.restored: bool = restore_session(state_path, session, source.type_name, self._uid)
        self._reported = -1.0

    def run(self, what_to_do: str, share: float, duration_s: float | None) -> None:
        """Gather until a share of the sensors has all that is wanted, for a time, or until Enter."""
        gathers = duration_s is None or duration_s > 0
        with self._kept():
            if gathers:
                self._wait_for_rest()
            if self._as_json:
                what = {"driver": self._reader.name, "type": self.type_name, "restored": self.restored}
                print_json({"event": "ready", **what, **self._figures()})
            else:
                echo(f"continuing with the data in {self._state_path}\n" * self.restored + what_to_do)
            if gathers:
                self._gather(share, duration_s)
        if not self._as_json:
            self._show_coverage()

    def weigh(self, weight_n: float, duration_s: float, source: ForceSource) -> None:
        """Ask for a known weight, and gather while it rests. Baselines are followed until Enter."""
        with self._kept():
            self._wait_for_rest()
            echo(f"lay {weight_n:g} N on the skin, and press Enter", err=True)
            if are_terminals(sys.stdin):
                for frame in frames_until(self._reader, enter_pressed):
                    self.source.loads(frame)
            source.weight_n, time_is_over = weight_n, after(duration_s)
            felt = np.zeros(len(self._uid), bool)
            for frame in frames_until(self._reader, time_is_over):
                loads = self.source.loads(frame)
                self._session.take(frame.acquired_ns, loads, source.newest())
                felt |= loads > 0
        if not felt.any():
            cli.warn(f"no sensor felt {weight_n:g} N: it does not count")
        elif not self._as_json:
            echo(f"{weight_n:g} N: {plural(int(felt.sum()), 'sensor')} felt it")

    @contextmanager
    def _kept(self) -> Iterator[None]:
        """Save the gathered data at the end of the block, and say on Ctrl-C where they are."""
        try:
            try:
                yield
            finally:
                self._save()
        except KeyboardInterrupt:
            if self._as_json:
                print_json({"event": "interrupted", "state": str(self._state_path), **self._figures()})
            else:
                echo(f"\nthe gathered data are in {self._state_path}; the same command continues with them")
            raise

    def _show_coverage(self) -> None:
        structure, type_name, coverage = self.structure, self.type_name, self._session.coverage
        for line in bars(structure, type_name, coverage):
            echo(line)
        echo()
        for line in picture(structure, type_name, coverage, min(terminal_width() or _WIDTH, _WIDTH)):
            echo(line)
        echo(f"\n{SIGNS[0]} nothing   {SIGNS[1]} to {SIGNS[-2]} some   {SIGNS[-1]} all that is wanted")

    def _gather(self, share: float, duration_s: float | None) -> None:
        time_is_over = after(math.inf if duration_s is None else duration_s)
        report_due, save_due = after(_REPORT_EVERY_S), after(_SAVE_EVERY_S)
        for frame in frames_until(
            self._reader, lambda: self._session.is_complete(share) or time_is_over() or enter_pressed()
        ):
            loads = self.source.loads(frame)
            if self.poses is None:
                self._session.take(frame.acquired_ns, loads, None)
            elif not self._reader.waiting:  # a pose belongs to the newest sample
                self._session.take(frame.acquired_ns, loads, self.poses.newest())
            if report_due():
                report_due = after(_REPORT_EVERY_S)
                self._report_progress()
            if save_due():
                save_due = after(_SAVE_EVERY_S)
                self._save()

    def _wait_for_rest(self) -> None:
        if not self.source.ready and not self._as_json:
            echo("leave the skin alone for some seconds ...")
        refused = 0.0
        for frame in frames_until(self._reader, lambda: self.source.ready):
            self.source.loads(frame)
            if self.source.refused_share and not refused:
                refused = self.source.refused_share
                cli.warn(f"{100 * refused:.0f} % of the sensors move and have no baseline yet; leave them alone")

    def _save(self) -> None:
        save_session(self._state_path, self._session, self.type_name, self._uid)

    def _figures(self) -> dict[str, Any]:
        coverage = self._session.coverage
        return {**self._session.figures, "sensors": len(coverage), "covered": int((coverage >= 1).sum())}

    def _report_progress(self) -> None:
        structure, coverage = self.structure, self._session.coverage
        figures = self._figures()
        if self._as_json:
            patch = structure.patch_of(self.type_name)
            patches = {
                name: round(float((coverage[patch == number] >= 1).mean()), 3)
                for number, name in enumerate(structure.patch_names)
                if (patch == number).any()
            }
            print_json({"event": "progress", **figures, "patches": patches})
            return
        mean = float(coverage.mean())
        if mean != self._reported:
            self._reported = mean
            gathered = ", ".join(f"{count} {name}" for name, count in self._session.figures.items())
            echo(f"{gathered}: {figures['covered']} of {figures['sensors']} sensors have enough")


@contextmanager
def opened(
    file: Path,
    session_of: Callable[[int], Any],
    how: GatheringOptions,
    poses: tuple[str, str, tuple[int, ...]] | None = None,
) -> Iterator[tuple[Gathering, Any]]:
    with ExitStack() as stack:
        namespace = Namespace(how.namespace)
        reader = stack.enter_context(reader_of(namespace, how.driver, "DRIVER"))
        source = LoadSource(reader.structure, reader.driver_type, how.type_name)
        pose_source = None
        if poses is not None:
            service, column, shape = poses
            pose_reader = stack.enter_context(ServiceReader(service, namespace=namespace, timeout_s=_POSES_TIMEOUT_S))
            pose_source = PoseSource(pose_reader, column, shape)
        state_path = how.state or file.with_name(f"{file.name}.state.npz")
        session = session_of(len(reader.structure.module_of(source.type_name)))
        gathering = Gathering(reader, session, source, pose_source, state_path, as_json=how.as_json)
        yield gathering, session


def places_in_frame(places: Geometry, frame: str) -> tuple[npt.NDArray[np.float64], bool]:
    """Places in the coordinate frame ``frame``, or else in the one with the most places; whether it is that frame."""
    frames = Counter(places.frame[places.known].tolist())
    here = frame if frame in frames else max(frames, key=lambda name: frames[name])
    return np.where((places.frame == here)[:, None], places.position_m, np.nan), here == frame


def read_layout(structure: Structure, type_name: str, layout: Path) -> tuple[Geometry, Mapping[int, Shape]]:
    """Return the places of sensors in a file, and the shapes of the modules that have places there."""
    places = read_geometry(layout).of(structure, type_name)
    kinds = [bytes(kind).decode() for kind in structure.module_kind.tolist()]
    shapes = shapes_of(structure.module_of(type_name), kinds, places.position_m, places.normal)
    if not shapes:
        raise ConfigurationError(f"{layout}: no whole module of this driver has places in it")
    return places, shapes


def write_places(file: Path, gathering: Gathering, placement: Placement, frame: str, pitch_m: float) -> None:
    structure, type_name = gathering.structure, gathering.type_name
    if not placement.known.any():
        raise click.ClickException("no sensor was pressed often enough; nothing is written")
    groups = placed_groups(structure, type_name, placement, frame, pitch_m)
    file.write_text(geometry_to_toml(groups, placed_comment(structure, type_name, placement)), encoding="utf-8")


def report_placed(as_json: bool, file: Path, placement: Placement, also: Mapping[str, Any], words: str) -> None:
    known, wrong = int(placement.known.sum()), int(placement.wrong.sum())
    tool, residual_mm = placement.tool, 1e3 * placement.spread_m
    figures = {"placed": known, "wrong": wrong, "residual_m": round(placement.spread_m, 6)}
    of_tool = {"corrected": tool.found, "doubts": tool.doubts, "unchecked_m": tool.unchecked}
    text = f"{file}: {known} sensors placed, {wrong} presses left out, residual {residual_mm:.1f} mm{words}"
    text = "\n".join([text, *tool.words()])
    say(as_json, {"event": "done", "file": str(file), **figures, **of_tool, **also}, text)
    click.get_current_context().exit(cli.EXIT_FAILED if tool.doubts else cli.EXIT_DONE)
