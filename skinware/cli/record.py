"""``skin-record``: record drivers and services."""

from __future__ import annotations

import contextlib
import errno
import json
import pkgutil
import re
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import are_terminals, echo, enter_pressed, print_json
from skinware.errors import ServiceNotFound
from skinware.text import plural

if TYPE_CHECKING:
    from skinware.recording.files import Target
    from skinware.recording.recorder import Recorder


def _listen_until_eof(recorder: Recorder) -> None:
    for line in sys.stdin:
        with contextlib.suppress(ValueError, KeyError, TypeError):
            told = json.loads(line)
            recorder.mark(str(told["text"]), int(told["time_ns"]))
    recorder.stop()  # the kernel closes it when the other program is killed


_UNITS = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([kMG]?i?)B?")
_TIME = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min)?")


def size(text: str) -> int:
    """Return a number of bytes: ``500MB``, ``2GiB``; for ``click.option(type=...)``."""
    found = _SIZE.fullmatch(text)
    if not found or found[2] not in _UNITS or not float(found[1]):
        raise click.BadParameter(f"{text!r} is not a size: give bytes, or a number with kB, MB, GB, MiB or GiB.")
    return round(float(found[1]) * _UNITS[found[2]])


def past(text: str) -> float:
    """Return a time in seconds: ``60``, ``60s``, ``5min``; for ``click.option(type=...)``."""
    found = _TIME.fullmatch(text)
    if not found or not float(found[1]):
        raise click.BadParameter(f"{text!r} is not a time: give seconds, or minutes as in 5min.")
    return float(found[1]) * (60 if found[2] == "min" else 1)


@cli.command(
    "skin-record",
    "skin-record                          everything, until Ctrl-C",
    "skin-record torso walk.mcap -T 60    one driver, one minute",
    "skin-record --split 1GB --max-size 20GB  the newest 20 GB, in files of 1 GB",
    "skin-record --last 60s               Enter, or kill -USR1, saves the last minute",
    "skin-record --wire                   also the frames on the buses, for skin-replay --wire",
)
@cli.names_argument
@cli.output_option("The new file.  [default: skin-DATE-TIME.mcap]")
@cli.duration_option()
@click.option(
    "--split", "split_size", metavar="SIZE", type=size, help="Begin another file after SIZE (1GB): FILE-001 ..."
)
@click.option(
    "--max-size", metavar="SIZE", type=size, help="End at SIZE; with --split, remove the oldest files beyond it."
)
@click.option(
    "--last",
    "last_s",
    metavar="TIME",
    type=past,
    help="Keep only the last TIME (60s, 5min), in memory; saved by Enter, SIGUSR1 and at the end.",
)
@click.option(
    "--viewers",
    "for_viewers",
    is_flag=True,
    help="Record also points, images and states for Foxglove and Lichtblick, 30 times a second.",
)
@click.option("--wire", "with_wires", is_flag=True, help="Record also the frames and bytes on the drivers' buses.")
@click.option("--until-eof", is_flag=True, hidden=True)
@click.option("--disguise", type=pkgutil.resolve_name, hidden=True)
@cli.namespace_option
@cli.json_option
def command(
    names: tuple[str, ...],
    output: Path | None,
    duration_s: float | None,
    split_size: int | None,
    max_size: int | None,
    last_s: float | None,
    for_viewers: bool,
    with_wires: bool,
    until_eof: bool,
    disguise: Callable[[], Callable[[str], str]] | None,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Record drivers and services NAME..., or all of them, with all counters and states.

    A NAME that ends in .mcap is the new file, as after -o.

    Samples that could not be recorded are counted in the file. If this command is killed, or the disk is full, all but
    the last 0.3 s is in the file, and skin-recover repairs it. If the file is deleted, moved or changed meanwhile, the
    recording ends within a second with status 1.

    Exit status: 0 ended or interrupted, 1 failed or no NAME appeared, 2 wrong usage.
    """
    from skinware.conversion.showing import Viewers
    from skinware.memory.namespace import Namespace, check_name
    from skinware.recording.recorder import Recorder

    if last_s is not None and (split_size or max_size):
        raise click.UsageError("--last keeps the past in memory: --split and --max-size are for files")
    files = [*filter(None, [output]), *(Path(name) for name in names if name.endswith(".mcap"))]
    if len(files) > 1:
        raise click.UsageError(f"one file is written, and {len(files)} are given: {', '.join(map(str, files))}")
    names = tuple(name for name in names if not name.endswith(".mcap"))
    for name in names:
        check_name(name, "service")
    place = Namespace(namespace)
    path = files[0] if files else Path(time.strftime("skin-%Y%m%d-%H%M%S.mcap"))
    target = _target(path, split_size, max_size, last_s)
    beside = Viewers().messages if for_viewers else None
    recorder = Recorder(
        target,
        names=names or None,
        namespace=place,
        with_wires=with_wires,
        disguise=None if disguise is None else disguise(),
        renderer=beside,
    )
    report = _Progress(recorder, target, path, as_json)
    if until_eof:
        threading.Thread(target=_listen_until_eof, args=(recorder,), daemon=True).start()
    with cli.signals_end(recorder.stop, {signal.SIGUSR1: recorder.save}):
        report.ready(names, place.name, is_past=last_s is not None)
        try:
            recorder.run(duration_s, report.status)
        except BaseException as error:
            report.stopped(getattr(error, "strerror", None) or str(error) or "interrupted")
            raise
        report.stopped()


def _target(path: Path, split_size: int | None, max_size: int | None, last_s: float | None) -> Target:
    from skinware.recording.files import Files, Past

    if path.exists():
        raise FileExistsError(errno.EEXIST, "exists already: give another name, or remove it", str(path))
    if last_s is not None:
        return Past(path, last_s)
    return Files(path, split_size=split_size, max_size=max_size)


class _Progress:
    def __init__(self, recorder: Recorder, target: Target, path: Path, as_json: bool) -> None:
        self._recorder, self._target, self._path, self._as_json = recorder, target, path, as_json
        self._begin_s = time.monotonic()
        self._before: dict[str, int] = {}
        self._names: tuple[str, ...] = ()
        self._namespace = ""
        self._is_past = False
        self._saved: list[Path] = []

    def ready(self, names: tuple[str, ...], namespace: str, *, is_past: bool) -> None:
        self._names, self._namespace, self._is_past = names, namespace, is_past
        if self._as_json:
            print_json({"event": "ready", "file": str(self._path), "namespace": namespace, "names": list(names)})
        else:
            what = ", ".join(names) or "all drivers and services"
            keys = f"{'Enter saves, ' * (is_past and are_terminals(sys.stdin))}Ctrl-C ends"
            echo(f"recording {what} of namespace {namespace!r} into {self._path} ({keys})")

    def status(self) -> None:
        if self._is_past and enter_pressed():
            self._recorder.save()
        self._news()
        messages = self._recorder.messages
        if self._as_json:
            with contextlib.suppress(BrokenPipeError):
                print_json({"event": "status", **self._figures(messages)})
            return
        rates = [
            f"{name.split('/')[2]} {count - self._before.get(name, 0)}/s"
            for name, count in messages.items()
            if name.endswith("/frame")
        ]
        self._before = messages
        missed = f", missed {self._recorder.missed}" if self._recorder.missed else ""
        passed = time.strftime("%H:%M:%S", time.gmtime(time.monotonic() - self._begin_s))
        echo(f"{passed}  {self._target.size / 1e6:.1f} MB  {', '.join(rates) or 'nothing yet'}{missed}")
        saved, self._saved = self._saved, self._target.paths if self._is_past else []
        for path in self._saved[len(saved) :]:
            echo(f"saved {path}")

    def _news(self) -> None:
        for event in self._recorder.news():
            if self._as_json:
                with contextlib.suppress(BrokenPipeError):
                    print_json(event)
            if event["event"] == "unreadable":
                cli.warn(f"{event['service']} is not recorded: {event['why']}")
            elif "for_ns" in event:
                suspended_s = event["for_ns"] / 1e9
                cli.warn(f"the machine was suspended for {suspended_s:.1f} s: nothing was recorded meanwhile")
            else:
                set_s = event["by_ns"] / 1e9
                cli.warn(f"the wall clock was set by {set_s:+.1f} s: times in the file go on as before")

    def stopped(self, problem: str = "") -> None:
        """Report the end: everything that was taken is in the files, unless there was a problem."""
        is_complete = not problem
        self._news()
        messages, files = self._recorder.messages, [str(path) for path in self._target.paths]
        expected = () if self._is_past else self._names  # which forgets those that appeared too early
        absent = [name for name in expected if not any(channel.split("/")[2:3] == [name] for channel in messages)]
        why = f"{', '.join(absent)} did not appear in namespace {self._namespace!r}"
        is_in_vain = is_complete and bool(expected) and len(absent) == len(expected)
        if absent and not is_in_vain:
            cli.warn(why)
        if self._as_json:
            with contextlib.suppress(BrokenPipeError):
                ends = {"file": (files or [""])[-1], "files": files, "is_complete": is_complete, "problem": problem}
                print_json({"event": "stopped", **ends, **self._figures(messages)})
        if is_in_vain:
            raise ServiceNotFound(why)
        if self._as_json:
            return
        for name, count in messages.items():
            echo(f"{name}: {plural(count, 'message')}")
        count = self._recorder.missed
        missed = f", {plural(count, 'sample')} missed" if count else ", nothing missed" * is_complete
        ended = "complete" if is_complete else "ended early"
        echo(f"{', '.join(files) or 'no file'}: {ended}, {self._target.size / 1e6:.1f} MB{missed}")

    def _figures(self, messages: dict[str, int]) -> dict[str, Any]:
        return {"messages": messages, "missed": self._recorder.missed, "bytes": self._target.size}


main = partial(cli.run, command, goes_on=True)


if __name__ == "__main__":
    main()
