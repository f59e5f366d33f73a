"""``skin-calibrate``: find the places of sensors by touching the skin, and check a geometry."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import say

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
    help="Distance between neighbouring sensors, metres.",
)
_offset = click.option(
    "--offset",
    "offset_m",
    type=float,
    metavar="M",
    default=0.0,
    help="Distance from sensors outwards to points: radius of the probe, and the cover. Needs --layout with normals.",
)
_gathering = cli.options(
    cli.driver_argument,
    cli.type_option("Sensors.  [default: pressure, or the first type]"),
    click.option(
        "--share",
        type=click.FloatRange(0, 1),
        metavar="X",
        default=0.95,
        help="Stop when this part of the sensors has enough.",
    ),
    cli.duration_option("Gather for SECONDS at most; 0: use the state file as it is."),
    click.option("--state", metavar="FILE", type=cli.FILE, help="File of gathered data.  [default: output.state.npz]"),
    cli.namespace_option,
    cli.json_option,
    cli.version_option,
)
_pressing = cli.options(
    click.option("--poses", "service", metavar="SERVICE", required=True, help="Service that publishes poses."),
    click.option("--touches", type=click.IntRange(1), metavar="N", default=5, help="Wanted on each sensor."),
    click.option("--frame", metavar="NAME", help="Coordinate frame of the poses.  [default: name of the service]"),
)


@cli.group("skin-calibrate")
def command() -> None:
    """Find the places of sensors by touching the skin; check a geometry.

    Gathering ends when there is enough, or with Enter. Ctrl-C interrupts it: gathered data stay in a state file, and
    the same command continues with them.
    """


@command.command(
    epilog=cli.examples(
        "skin-calibrate topology -o map.toml                    stroke the skin for some minutes",
        "skin-calibrate topology torso --namespace calm -o map.toml    a driver that skin-calm calms",
    )
)
@_output
@_pitch
@_gathering
def topology(file: Path, pitch_m: float, **options: Any) -> None:
    """Find which sensors of DRIVER, or of the only one that runs, lie side by side, from strokes with a finger.

    It draws a map of each piece of skin; curved pieces are unrolled. It ends when 95 % of the sensors have felt the
    finger in 20 samples; longer strokes give better maps.
    """
    import numpy as np

    from skinware.cli._gathering import GatheringOptions, opened
    from skinware.geometry import geometry_to_toml
    from skinware.tactile.calibration.results import unrolled_comment, unrolled_groups
    from skinware.tactile.calibration.state import StrokeSession
    from skinware.tactile.calibration.topology import topology_of
    from skinware.text import plural

    how = GatheringOptions(**options)
    with opened(file, StrokeSession, how) as (gathering, session):
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
@click.option("--column", metavar="NAME", default="point_m", help="With the points, metres.")
@click.option("--layout", metavar="FILE", type=cli.FILE, help="Geometry whose modules have the right shapes.")
@_offset
@_pitch
@_gathering
def touch(
    file: Path,
    service: str,
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
    from skinware.cli._gathering import (
        GatheringOptions,
        opened,
        places_in_frame,
        read_layout,
        report_placed,
        write_places,
    )
    from skinware.tactile.calibration.placing import place
    from skinware.tactile.calibration.state import PressSession

    how = GatheringOptions(**options)
    if offset_m and layout is None:
        raise click.UsageError("--offset needs --layout, which has the normals")
    session_of = partial(PressSession, wanted=touches)
    where = (service, column, (3,))
    with opened(file, session_of, how, where) as (gathering, session):
        structure, type_name, shapes, layout_m, is_here = gathering.structure, gathering.type_name, None, None, False
        if layout is not None:
            places, shapes = read_layout(structure, type_name, layout)
            layout_m, is_here = places_in_frame(places, frame or service)
        gathering.run(_PRESS, how.share, how.duration_s)
        placement = place(session.presses, shapes, offset_m=offset_m, layout_m=layout_m, is_here=is_here)
        write_places(file, gathering, placement, frame or service, pitch_m)
    report_placed(how.as_json, file, placement, {}, "")


@command.command(
    epilog=cli.examples(
        "skin-calibrate finger --poses robot --layout cad.toml -o skin.toml    the robot publishes pose, 4 x 4",
        "skin-calibrate finger --poses robot --layout cad.toml --tip 0 0 0.12 -o skin.toml",
    )
)
@_output
@_pressing
@click.option("--column", metavar="NAME", default="pose", help="With the poses, 4 x 4, metres.")
@click.option(
    "--layout", metavar="FILE", type=cli.FILE, required=True, help="Geometry whose modules have the right shapes."
)
@click.option(
    "--tip",
    "tip_m",
    type=float,
    nargs=3,
    metavar="X Y Z",
    default=(0, 0, 0),
    help="Estimate of the tip in the frame of its carrier, metres.",
)
@_offset
@_pitch
@_gathering
def finger(
    file: Path,
    service: str,
    touches: int,
    frame: str | None,
    column: str,
    layout: Path,
    tip_m: tuple[float, float, float],
    offset_m: float,
    pitch_m: float,
    **options: Any,
) -> None:
    """Find the places of modules and the length of the finger, from poses of the part that carries the finger.

    For robots that touch themselves: the pose of the hand is known in the coordinate frame of the skin, but the tip of
    the finger is not known exactly.
    """
    from skinware.cli._gathering import GatheringOptions, opened, read_layout, report_placed, write_places
    from skinware.tactile.calibration.finger import place_finger
    from skinware.tactile.calibration.state import PressSession

    how = GatheringOptions(**options)
    session_of = partial(PressSession, wanted=touches, pose_shape=(4, 4))
    where = (service, column, (4, 4))
    with opened(file, session_of, how, where) as (gathering, session):
        structure, type_name = gathering.structure, gathering.type_name
        _, shapes = read_layout(structure, type_name, layout)
        gathering.run(_PRESS, how.share, how.duration_s)
        found = place_finger(session.presses, shapes, tip_m, offset_m=offset_m)
        write_places(file, gathering, found, frame or service, pitch_m)
    tip = [round(number, 6) for number in found.tip_m.tolist()]
    words = f"; the tip is at {', '.join(f'{1e3 * number:.1f}' for number in tip)} mm"
    report_placed(how.as_json, file, found, {"tip_m": tip}, words)


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
    from skinware.cli._gathering import GatheringOptions, finding_data, finding_text, opened
    from skinware.geometry import read_geometry
    from skinware.tactile.calibration.checking import check_file, check_strokes
    from skinware.tactile.calibration.state import StrokeSession
    from skinware.tactile.calibration.topology import topology_of

    geometry = read_geometry(file)
    how = GatheringOptions(**options)
    with opened(file, StrokeSession, how) as (gathering, session):
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
@click.option("--column", metavar="NAME", default="force_n", help="With 1 or 3 forces, N.")
@click.option("--axes", type=click.Choice(["1", "3"]), default="1", help="Forces in the column.")
@click.option("--newtons", type=click.FloatRange(0), multiple=True, metavar="N", help="A weight; may be repeated.")
@click.option("--weight-s", type=click.FloatRange(0.5), metavar="SECONDS", default=8.0, help="How long each rests.")
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
    from skinware.cli._gathering import GatheringOptions, opened
    from skinware.tactile.calibration.force import fit_force
    from skinware.tactile.calibration.sources import ForceSource
    from skinware.tactile.calibration.state import ForceSession
    from skinware.tactile.curves import curves_to_toml

    how = GatheringOptions(**options)
    if (reference is None) == (not newtons) and how.duration_s != 0:
        raise click.UsageError("give either --reference or --newtons")
    where = None if reference is None else (reference, column, (int(axes),))
    with opened(file, ForceSession, how, where) as (gathering, session):
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


main = partial(cli.run, command)
