"""``skin-replay``: publish a recording again."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import (
    CONTEXT_SETTINGS,
    examples,
    json_option,
    run,
    seconds,
    signals_end,
    version_option,
    warn,
)
from skinware.cli._terminal import echo, print_json
from skinware.errors import BadServiceFile, ConfigurationError, ServiceNotFound

if TYPE_CHECKING:
    from skinware.memory.namespace import Namespace
    from skinware.recording import Recording
    from skinware.recording.replaying import Replayer

_NAMESPACE = "replay"
_DRAW_EVERY_S = 0.1


def speed(text: str) -> float:
    """A factor above 0; for ``click.option(type=...)``.

    Raises:
        click.BadParameter: it is not one.
    """
    factor = seconds(text)
    if not factor:
        raise click.BadParameter("a speed is above 0: 1 is that of the recording.")
    return factor


@click.command(
    "skin-replay",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-replay walk.mcap                         skin-top --namespace replay shows it",
        "skin-replay walk.mcap torso --speed 0.5       one driver, half as fast",
        "skin-replay walk.mcap --start 10 --end 12 --loop",
        "skin-replay walk.mcap --paused                step through it with . and ,",
    ),
)
@click.argument("file", type=click.Path(path_type=Path))
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--speed", "factor", type=speed, default="1", show_default=True, metavar="X", help="2: twice as fast.")
@click.option("--start", "start_s", type=seconds, default="0", metavar="SECONDS", help="Begin there.")
@click.option("--end", "end_s", type=seconds, metavar="SECONDS", help="End there.")
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option("--paused", is_flag=True, help="Wait for a key or a request first.")
@click.option("--stay", is_flag=True, help="Pause at the end, instead of ending.")
@click.option(
    "--times",
    type=click.Choice(["now", "recorded"]),
    default="now",
    show_default=True,
    help="Times of frames: moved to now, so that ages are as they were; or those of then.",
)
@click.option(
    "--namespace",
    metavar="NAME",
    help=f"Namespace to publish in.  [default: $SKINWARE_NAMESPACE, else '{_NAMESPACE}', if nothing runs there]",
)
@json_option
@version_option
def command(
    file: Path,
    names: tuple[str, ...],
    factor: float,
    start_s: float,
    end_s: float | None,
    loop: bool,
    paused: bool,
    stay: bool,
    times: str,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Publish the drivers and services of a recording again, or only NAME..., as if they ran now.

    They have the same names, structures, states and counters, and restart where they restarted. In a terminal, keys
    pause, step, seek and change the speed; other programs ask any of the services for the same (pause, resume, step,
    seek, speed, loop, replay).

    Exit status: 0 ended or interrupted, 1 failed, 2 wrong usage.
    """
    import skinware.recording
    from skinware.cli._replay_keys import KEYS, Terminal
    from skinware.memory.namespace import Namespace
    from skinware.recording.replaying import Replayer

    place = Namespace(namespace or os.environ.get("SKINWARE_NAMESPACE") or _NAMESPACE)
    _heed_others(place, is_chosen=bool(namespace))
    with skinware.recording.open(file) as recording:
        replayer = Replayer(
            recording,
            names=names or None,
            namespace=place,
            speed=factor,
            start_s=start_s,
            end_s=end_s,
            loop=loop,
            paused=paused,
            stays=stay,
            keeps_times=times == "recorded",
        )
        terminal = Terminal(replayer)
        has_keys = not as_json and terminal.is_ours
        continued = {signal.SIGCONT: terminal.take} if has_keys else {}
        with contextlib.closing(replayer), signals_end(replayer.stop, continued):
            _ready(recording, names, place.name, as_json)
            if has_keys:
                echo(KEYS)
                with terminal.keys():
                    replayer.run(terminal.draw, _DRAW_EVERY_S)
            else:
                replayer.run(lambda: _tell("status", replayer, as_json))
        for problem in recording.problems:
            warn(problem)
    _tell("stopped", replayer, as_json)


def _heed_others(place: Namespace, *, is_chosen: bool) -> None:
    """Keep recorded frames away from living ones; where the namespace was given on purpose, only warn of them.

    Raises:
        ConfigurationError: services run in the namespace that is the default.
    """
    from skinware.service import ServiceReader

    living = []
    for name in place.services():
        with contextlib.suppress(BadServiceFile, ServiceNotFound):
            with ServiceReader[Any](name, namespace=place, announce=False) as reader:
                living += [name] if reader.alive else []
    run = f"{', '.join(living)} {'runs' if len(living) == 1 else 'run'}"
    if living and is_chosen:
        warn(f"{run} in namespace {place.name!r} too: readers have living and recorded frames side by side")
    elif living:
        raise ConfigurationError(
            f"{run} in namespace {place.name!r}: give another one with --namespace, or"
            f" --namespace {place.name} to publish beside them"
        )


def _ready(recording: Recording, names: tuple[str, ...], namespace: str, as_json: bool) -> None:
    published = list(names or recording.services)
    if as_json:
        told = {"file": str(recording.path), "namespace": namespace, "names": published}
        print_json({"event": "ready", **told, "duration_s": recording.duration_s, "is_whole": recording.is_whole})
    else:
        what = ", ".join(published) or "nothing"
        echo(f"{recording.path}, {recording.duration_s:.1f} s: {what} in namespace {namespace!r} (Ctrl-C ends)")


def _tell(event: str, replayer: Replayer, as_json: bool) -> None:
    with contextlib.suppress(BrokenPipeError):
        if as_json:
            print_json({"event": event, **replayer.replay(), "frames": dict(replayer.frames)})
        elif event == "stopped":
            late = f", {replayer.late} of them late" if replayer.late else ""
            echo(f"{replayer.frames.total()} frames published{late}")


def main() -> None:
    run(command, goes_on=True)
