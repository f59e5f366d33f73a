"""``skin-calibrate``: find the places of sensors by touching the skin, and check a geometry."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import say
from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from skinware.cli._gathering import Gathering
    from skinware.geometry import Geometry
    from skinware.structure import Structure
    from skinware.tactile.calibration.placing import Placement
    from skinware.tactile.calibration.shapes import Shape

_POSES_TIMEOUT_S = 5.0
_MM = 1e3
_STROKE = "stroke the whole skin with one finger"
_PUSH = "press the skin through the reference, with forces that rise, rest and fall"
_PRESS = "press the skin at known places; hold each for a moment"


_output = cli.output_option("File to write.", name="file", metavar="FILE", required=True)
_pitch = click.option(
    "--pitch",
    "pitch_m",
    type=click.FloatRange(0, min_open=True),
    metavar="M",
    default=0.0065,
    show_default=True,
    help="Distance between neighbouring sensors, metres.",
)
_gathering = cli.options(
    cli.driver_option,
    cli.type_option("Sensors.  [default: pressure, or the first type]"),
    click.option(
        "--share",
        type=click.FloatRange(0, 1),
        default=0.95,
        show_default=True,
        help="Stop when this part of the sensors has enough.",
    ),
    cli.duration_option("Gather for SECONDS at most; 0: use the state file as it is."),
    click.option("--state", metavar="FILE", type=cli.FILE, help="File of gathered data.  [default: output.state.npz]"),
    click.option("--fresh", is_flag=True, help="Begin with nothing, and ignore that file."),
    cli.namespace_option,
    cli.json_option,
    cli.version_option,
)
_pressing = cli.options(
    click.option("--poses", "service", metavar="SERVICE", required=True, help="Service that publishes poses."),
    click.option("--poses-namespace", metavar="NAME", help="Namespace of that service.  [default: as --namespace]"),
    click.option("--touches", type=click.IntRange(1), default=5, show_default=True, help="Wanted on each sensor."),
    click.option("--frame", metavar="NAME", help="Coordinate frame of the poses.  [default: name of the service]"),
)


@dataclass(frozen=True)
class _How:
    """The options of all commands that gather."""

    driver: str | None
    type_name: str | None
    share: float
    duration_s: float | None
    state: Path | None
    fresh: bool
    namespace: str | None
    as_json: bool


@click.group("skin-calibrate", context_settings=cli.CONTEXT_SETTINGS)
@cli.version_option
def command() -> None:
    """Find the places of sensors by touching the skin; check a geometry.

    Gathering ends when there is enough, or with Enter. Ctrl-C interrupts it: gathered data stay in a state file, and
    the same command continues with them.
    """


@command.command(
    epilog=cli.examples(
        "skin-calibrate topology -o map.toml                    stroke the skin for some minutes",
        "skin-calibrate topology --namespace calm -o map.toml    with the driver of skin-calm",
    )
)
@_output
@_pitch
@_gathering
def topology(file: Path, pitch_m: float, **options: Any) -> None:
    """Find which sensors lie side by side, from strokes with a finger, and draw a map of each piece of skin.

    Only a finger is needed. Curved pieces are unrolled. It ends when 95 % of the sensors have felt the finger in 20
    frames; longer strokes give better maps.
    """
    import numpy as np

    from skinware.geometry import geometry_to_toml
    from skinware.tactile.calibration.results import unrolled_comment, unrolled_groups
    from skinware.tactile.calibration.state import StrokeSession
    from skinware.tactile.calibration.topology import topology_of
    from skinware.text import plural

    how = _How(**options)
    with _opened(file, StrokeSession, how) as (gathering, session):
        gathering.run(_STROKE, how.share, how.duration_s)
        found = topology_of(session.sums, pitch_m)
        groups = unrolled_groups(gathering.structure, gathering.type_name, found)
        file.write_text(geometry_to_toml(groups, unrolled_comment(found)), encoding="utf-8")
    pieces, placed = np.bincount(found.piece[found.piece >= 0]).tolist(), int(found.linked.sum())
    loose = sum(pieces) - placed
    words = f"{file}: {placed} sensors in {plural(len(pieces), 'piece')}, {len(found.pairs)} pairs of neighbours"
    words += f"; {loose} not placed: stroke from the rest of their piece to them and back" if loose else ""
    done = {"placed": placed, "loose": loose, "pieces": pieces, "neighbours": len(found.pairs)}
    say(how.as_json, {"event": "done", "file": str(file), **done}, words)


@command.command(
    epilog=cli.examples(
        "skin-calibrate touch --poses robot -o skin.toml                       the robot publishes point_m",
        "skin-calibrate touch --poses robot --layout cad.toml -o skin.toml     modules are shaped as in cad.toml",
    )
)
@_output
@_pressing
@click.option("--column", metavar="NAME", default="point_m", show_default=True, help="With the points, metres.")
@click.option("--layout", metavar="FILE", type=cli.FILE, help="Geometry whose modules have the right shapes.")
@click.option(
    "--offset",
    "offset_m",
    type=float,
    metavar="M",
    default=0.0,
    help="Distance from sensors outwards to points: radius of the probe, and the cover. Needs --layout with normals.",
)
@_pitch
@_gathering
def touch(
    file: Path,
    service: str,
    poses_namespace: str | None,
    touches: int,
    frame: str | None,
    column: str,
    layout: Path | None,
    offset_m: float,
    pitch_m: float,
    **options: Any,
) -> None:
    """Find the places of sensors from presses at points that a service publishes.

    A press is a touch whose point rests for 0.2 s. Wrong presses are found and left out. With the shapes of the
    modules, places are twice as good, untouched sensors are placed too, and normals are known. Drift, lag and play of
    the tool are corrected where the presses show them; press each place at different times and from all directions.

    Exit status: 0 the places can be trusted, 1 they are written, and cannot.
    """
    from skinware.tactile.calibration.placing import place
    from skinware.tactile.calibration.state import PressSession

    how = _How(**options)
    if offset_m and layout is None:
        raise click.UsageError("--offset needs --layout, which has the normals")
    session_of = partial(PressSession, wanted=touches)
    where = (service, poses_namespace, column, (3,))
    with _opened(file, session_of, how, where) as (gathering, session):
        structure, type_name, shapes, layout_m, is_here = gathering.structure, gathering.type_name, None, None, False
        if layout is not None:
            places = _places(structure, type_name, layout)
            shapes = _shapes(structure, type_name, layout, places)
            layout_m, is_here = _layout_m(places, frame or service)
        gathering.run(_PRESS, how.share, how.duration_s)
        placement = place(session.presses, shapes, offset_m=offset_m, layout_m=layout_m, is_here=is_here)
        _write(file, gathering, placement, frame or service, pitch_m)
    _report_placed(how.as_json, file, placement, {}, "")


@command.command(
    epilog=cli.examples(
        "skin-calibrate finger --poses robot --layout cad.toml -o skin.toml    the robot publishes pose, 4 x 4",
        "skin-calibrate finger --poses robot --layout cad.toml --tip 0 0 0.12 -o skin.toml",
    )
)
@_output
@_pressing
@click.option("--column", metavar="NAME", default="pose", show_default=True, help="With the poses, 4 x 4, metres.")
@click.option(
    "--layout", metavar="FILE", type=cli.FILE, required=True, help="Geometry whose modules have the right shapes."
)
@click.option(
    "--tip",
    "tip_m",
    type=float,
    nargs=3,
    default=(0, 0, 0),
    help="Estimate of the tip in the frame of its carrier.",
)
@_pitch
@_gathering
def finger(
    file: Path,
    service: str,
    poses_namespace: str | None,
    touches: int,
    frame: str | None,
    column: str,
    layout: Path,
    tip_m: tuple[float, float, float],
    pitch_m: float,
    **options: Any,
) -> None:
    """Find the places of modules and the length of the finger, from poses of the part that carries the finger.

    For robots that touch themselves: the pose of the hand is known in the coordinate frame of the skin, but the tip of
    the finger is not known exactly.
    """
    from skinware.tactile.calibration.finger import place_finger
    from skinware.tactile.calibration.state import PressSession

    how = _How(**options)
    session_of = partial(PressSession, wanted=touches, pose_shape=(4, 4))
    where = (service, poses_namespace, column, (4, 4))
    with _opened(file, session_of, how, where) as (gathering, session):
        structure, type_name = gathering.structure, gathering.type_name
        shapes = _shapes(structure, type_name, layout, _places(structure, type_name, layout))
        gathering.run(_PRESS, how.share, how.duration_s)
        found = place_finger(session.presses, shapes, tip_m)
        _write(file, gathering, found, frame or service, pitch_m)
    tip = [round(number, 6) for number in found.tip_m.tolist()]
    words = f"; the tip is at {', '.join(f'{_MM * number:.1f}' for number in tip)} mm"
    _report_placed(how.as_json, file, found, {"tip_m": tip}, words)


@command.command(
    epilog=cli.examples(
        "skin-calibrate check skin.toml                       stroke the skin for some minutes",
        "skin-calibrate check skin.toml --state map.toml.state.npz -T 0    with strokes of skin-calibrate topology",
    )
)
@click.argument("file", metavar="GEOMETRY", type=cli.FILE)
@_pitch
@_gathering
@click.pass_context
def check(context: click.Context, /, file: Path, pitch_m: float, **options: Any) -> None:
    """Compare a geometry with strokes over the skin.

    Reports exchanged modules and patches, mirrored and turned modules, sensors that share a place or have none, and
    sensors that are more than 10 mm off.

    Exit status: 0 nothing found, 1 something is wrong.
    """
    from skinware.cli._gathering import finding_data, finding_text
    from skinware.geometry import read_geometry
    from skinware.tactile.calibration.checking import check_file, check_strokes
    from skinware.tactile.calibration.state import StrokeSession
    from skinware.tactile.calibration.topology import topology_of

    geometry = read_geometry(file)
    how = _How(**options)
    with _opened(file, StrokeSession, how) as (gathering, session):
        gathering.run(_STROKE, how.share, how.duration_s)
        structure, type_name = gathering.structure, gathering.type_name
    places, module = geometry.of(structure, type_name), structure.module_of(type_name)
    found = check_file(places, module)
    if session.sums.frames:
        topology = topology_of(session.sums, pitch_m)
        found += check_strokes(places, module, structure.patch_of(type_name), topology)
    for finding in found:
        data = {"event": "finding", **finding_data(finding, structure, type_name)}
        say(how.as_json, data, finding_text(finding, structure, type_name))
    say(
        how.as_json,
        {"event": "done", "file": str(file), "findings": len(found), "compared": session.sums.frames > 0},
        f"{file}: {len(found) or 'nothing'} found{'' if session.sums.frames else '; no strokes to compare it with'}",
    )
    context.exit(cli.EXIT_FAILED if found else cli.EXIT_DONE)


@command.command(
    epilog=cli.examples(
        "skin-calibrate force --reference loadcell -o curves.toml          a service publishes force_n",
        "skin-calibrate force --newtons 0.5 --newtons 1 --newtons 2 -o curves.toml    known weights",
    )
)
@_output
@click.option("--reference", metavar="SERVICE", help="Service of a load cell or force-torque sensor.")
@click.option("--column", metavar="NAME", default="force_n", show_default=True, help="With 1 or 3 forces, N.")
@click.option("--axes", type=click.Choice(["1", "3"]), default="1", show_default=True, help="Forces in the column.")
@click.option("--newtons", type=click.FloatRange(0), multiple=True, metavar="N", help="A known weight, N; repeat it.")
@click.option("--weight-s", type=click.FloatRange(0.5), default=8.0, show_default=True, help="How long each rests.")
@_gathering
def force(
    file: Path,
    reference: str | None,
    column: str,
    axes: str,
    newtons: tuple[float, ...],
    weight_s: float,
    **options: Any,
) -> None:
    """Find the curves from values to newtons, from presses beside a reference.

    Press each part of the skin with forces that rise, rest and fall, through the load cell, or lay known weights on it.
    The file is for the stage "curve" of skin-calm.

    Exit status: 0 the curves can be trusted, 1 they are written, and cannot.
    """
    from skinware.tactile.calibration.force import fit_force
    from skinware.tactile.calibration.sources import ForceSource
    from skinware.tactile.calibration.state import ForceSession
    from skinware.tactile.curves import curves_to_toml

    how = _How(**options)
    if (reference is None) == (not newtons) and how.duration_s != 0:
        raise click.UsageError("give either --reference or --newtons")
    where = None if reference is None else (reference, how.namespace, column, (int(axes),))
    with _opened(file, ForceSession, how, where) as (gathering, session):
        source = gathering.poses = ForceSource(gathering.source, gathering.poses)
        for weight_n in newtons:
            gathering.weigh(weight_n, weight_s, source)
        if not newtons:
            gathering.run(_PUSH, how.share, how.duration_s)
        structure, type_name = gathering.structure, gathering.type_name
        fit = fit_force(session.data, type_name, structure.type(type_name).unit)
    uid = structure.sensor_uid[structure.index(type_name)]
    doubts = "; ".join(fit.doubts)
    own, curve = int(sum(fit.gain == fit.gain)), fit.curve
    error = f"{1e3 * fit.residual_n:.0f} mN of {fit.reach_n:.3g} N"
    words = f"residual {error}; up to {curve.x[-1]:.4g} {curve.from_unit}; hysteresis {100 * fit.hysteresis:.0f} %"
    words += f"; not trustworthy: {doubts}" if doubts else ""
    file.write_text(curves_to_toml(fit.curves(uid), words), encoding="utf-8")
    figures = {"residual_n": fit.residual_n, "reach_n": fit.reach_n, "held": fit.held, "doubts": fit.doubts}
    done = {"event": "done", "file": str(file), "curves": own, **figures}
    say(how.as_json, done, f"{file}: {own} sensors; {words}")
    click.get_current_context().exit(cli.EXIT_FAILED if doubts else cli.EXIT_DONE)


@contextmanager
def _opened(
    file: Path,
    session_of: Callable[[int], Any],
    how: _How,
    poses: tuple[str, str | None, str, tuple[int, ...]] | None = None,
) -> Iterator[tuple[Gathering, Any]]:
    """Yield a gathering, with driver and poses open, and its session."""
    from skinware.cli._gathering import Gathering
    from skinware.memory.namespace import Namespace
    from skinware.service import ServiceReader
    from skinware.tactile.calibration.sources import LoadSource, PoseSource
    from skinware.views.live import reader_of

    with ExitStack() as stack:
        reader = stack.enter_context(reader_of(Namespace(how.namespace), how.driver, "--driver"))
        source = LoadSource(reader.structure, reader.driver_type, how.type_name)
        pose_source = None
        if poses is not None:
            service, poses_namespace, column, shape = poses
            place = Namespace(poses_namespace or how.namespace)
            pose_reader = stack.enter_context(ServiceReader(service, namespace=place, timeout_s=_POSES_TIMEOUT_S))
            pose_source = PoseSource(pose_reader, column, shape)
        state_path = how.state or file.with_name(f"{file.name}.state.npz")
        session = session_of(len(reader.structure.module_of(source.type_name)))
        gathering = Gathering(reader, session, source, pose_source, state_path, fresh=how.fresh, as_json=how.as_json)
        yield gathering, session


def _places(structure: Structure, type_name: str, layout: Path) -> Geometry:
    from skinware.geometry import read_geometry

    return read_geometry(layout).of(structure, type_name)


def _layout_m(places: Geometry, frame: str) -> tuple[npt.NDArray[np.float64], bool]:
    """Places in the coordinate frame ``frame``, or else in the one with the most places; whether it is that frame."""
    from collections import Counter

    import numpy as np

    frames = Counter(places.frame[places.known].tolist())
    here = frame if frame in frames else max(frames, key=lambda name: frames[name])
    return np.where((places.frame == here)[:, None], places.position_m, np.nan), here == frame


def _shapes(structure: Structure, type_name: str, layout: Path, places: Geometry) -> Mapping[int, Shape]:
    from skinware.tactile.calibration.shapes import shapes_of

    kinds = [bytes(kind).decode() for kind in structure.module_kind.tolist()]
    shapes = shapes_of(structure.module_of(type_name), kinds, places.position_m, places.normal)
    if not shapes:
        raise ConfigurationError(f"{layout}: no whole module of this driver has places in it")
    return shapes


def _write(file: Path, gathering: Gathering, placement: Placement, frame: str, pitch_m: float) -> None:
    from skinware.geometry import geometry_to_toml
    from skinware.tactile.calibration.results import placed_comment, placed_groups

    structure, type_name = gathering.structure, gathering.type_name
    if not placement.known.any():
        raise click.ClickException("no sensor was pressed often enough; nothing is written")
    groups = placed_groups(structure, type_name, placement, frame, pitch_m)
    file.write_text(geometry_to_toml(groups, placed_comment(structure, type_name, placement)), encoding="utf-8")


def _report_placed(as_json: bool, file: Path, placement: Placement, also: Mapping[str, Any], words: str) -> None:
    known, wrong = int(placement.known.sum()), int(placement.wrong.sum())
    tool, residual_mm = placement.tool, _MM * placement.spread_m
    figures = {"placed": known, "wrong": wrong, "residual_m": round(placement.spread_m, 6)}
    of_tool = {"corrected": tool.found, "doubts": tool.doubts, "unchecked_m": tool.unchecked}
    text = f"{file}: {known} sensors placed, {wrong} presses left out, residual {residual_mm:.1f} mm{words}"
    text = "\n".join([text, *tool.words()])
    say(as_json, {"event": "done", "file": str(file), **figures, **of_tool, **also}, text)
    click.get_current_context().exit(cli.EXIT_FAILED if tool.doubts else cli.EXIT_DONE)


def main() -> None:
    cli.run(command)
