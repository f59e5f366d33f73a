"""``skin-bridge rerun`` and ``skin-bridge foxglove``: show drivers live in other people's viewers."""

from __future__ import annotations

from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import say
from skinware.errors import MissingExtra

if TYPE_CHECKING:
    from skinware.conversion.live import Sink

_RERUN, _FOXGLOVE_PORT = "rerun+http://127.0.0.1:9876/proxy", 8765

_rate_option = click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(0.1, 1000),
    default=30.0,
    show_default=True,
    metavar="HZ",
    help="Highest rate of snapshots.",
)


@click.command(
    "rerun",
    epilog=cli.examples(
        "skin-bridge rerun                 into the viewer that runs: rerun",
        "skin-bridge rerun arm -o arm.rrd  into a file",
    ),
)
@cli.names_argument
@click.option("--connect", metavar="URL", default=_RERUN, show_default=True, help="Viewer or server.")
@cli.output_option("Write this file instead.", name="file")
@_rate_option
@cli.namespace_option
@cli.json_option
def rerun(
    names: tuple[str, ...], connect: str, file: Path | None, rate_hz: float, namespace: str | None, as_json: bool
) -> None:
    """Show drivers NAME..., or all, also later ones, in Rerun: taxels with values and status, and contacts.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    try:
        import rerun
    except ImportError:
        raise MissingExtra("this needs a package that is not installed: pip install 'skinware[rerun]'") from None
    from skinware.conversion.live import RerunSink

    recording = rerun.RecordingStream("skinware")
    if file is None:
        recording.connect_grpc(connect)
    else:
        recording.save(file)
    _run(RerunSink(recording), names, rate_hz, namespace, as_json, connect if file is None else str(file))
    recording.flush()
    recording.disconnect()


@click.command(
    "foxglove",
    epilog=cli.examples("skin-bridge foxglove   then, in Foxglove: open a connection to ws://127.0.0.1:8765"),
)
@cli.names_argument
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address to listen at; anybody who reaches it sees the skin."
)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=_FOXGLOVE_PORT, show_default=True, help="0: any that is free."
)
@_rate_option
@cli.namespace_option
@cli.json_option
def foxglove(
    names: tuple[str, ...], host: str, port: int, rate_hz: float, namespace: str | None, as_json: bool
) -> None:
    """Show drivers NAME..., or all, also later ones, in Foxglove: point clouds, images and states.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    try:
        import foxglove
    except ImportError:
        raise MissingExtra("this needs a package that is not installed: pip install 'skinware[foxglove]'") from None
    from skinware.conversion.live import FoxgloveSink

    context = foxglove.Context()
    try:
        server = foxglove.start_server(name="skinware", host=host, port=port, context=context)
    except RuntimeError as error:
        raise click.ClickException(f"{host}, port {port}: {error}") from None
    where = f"ws://{f'[{host}]' if ':' in host else host}:{server.port}"
    try:
        _run(FoxgloveSink(context), names, rate_hz, namespace, as_json, where)
    finally:
        server.stop()


def _run(sink: Sink, names: tuple[str, ...], rate_hz: float, namespace: str | None, as_json: bool, where: str) -> None:
    """Show drivers until a signal ends it."""
    from skinware.conversion.live import stream
    from skinware.memory.namespace import Namespace, check_name

    for name in names:
        check_name(name, "driver")
    place, stop = Namespace(namespace), Event()
    with cli.signals_end(stop.set):
        ready = {"event": "ready", "to": where, "namespace": place.name}
        say(as_json, ready, f"namespace {place.name!r} to {where} (Ctrl-C ends)")
        stream(place, names, sink, rate_hz, stop)
