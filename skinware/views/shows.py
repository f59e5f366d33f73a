"""Show viewers the drivers that run, or recordings that one viewer plays, with an outline of each."""

from __future__ import annotations

import itertools
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, SkinwareError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.tactile.contacts_service import NAME as CONTACTS
from skinware.views.following import Follower, Origin
from skinware.views.looks import Replay
from skinware.views.programs import REPLAY_VALUES, ReplayControl

if TYPE_CHECKING:
    from skinware.recording import Recording

SUFFIX = ".mcap"
MOST_BESIDE = 4
"""Recordings that a viewer sees at once."""

_REPORT_EVERY_S = 0.05
_OUTLINE_EVERY_NS = NS_PER_S // 4
_numbers = itertools.count(1)
_MOST_BINS = 480
_LEAST_BIN_S = 0.25
_MOST_EVENTS = 500
_USUAL = ("found", "live")
"""Events of every recording."""

Counts = npt.NDArray[np.int64]


class Outline:
    """The course of a recording in bins of equal time.

    Args:
        recording: to outline; this alone reads from it.

    Attributes:
        until_s: the part so far is outlined.
        samples: (bins,) samples of drivers.
        missed: (bins,) samples that the recorder missed.
        contacts: (bins,) the most contacts at once; None where no contacts were recorded.
        events: each with ``time_s``, ``event``, ``service`` and, for a mark, ``text``; the first ones.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.until_s = 0.0
        self._bins = min(_MOST_BINS, max(1, int(recording.duration_s / _LEAST_BIN_S)))
        self.samples: Counts = np.zeros(self._bins, np.int64)
        self.missed: Counts = np.zeros(self._bins, np.int64)
        self.contacts: Counts | None = None
        self.events: list[dict[str, Any]] = []

    def steps(self) -> Iterator[None]:
        """Read the recording from its begin to its end, and yield after each part: some hundred samples."""
        recording = self._recording
        for event in recording.events:
            time_s, what = event["time_s"], event.get("event", "")
            if what == "missed":
                self.missed[self._bin(time_s)] += event.get("count", 0)
            elif what not in _USUAL and len(self.events) < _MOST_EVENTS:
                known = {key: str(event.get(key, "")) for key in ("event", "service", "text", "why")}
                self.events.append({"time_s": time_s} | {key: text for key, text in known.items() if text})
        yield
        tracks = [recording[name] for name in recording.services]
        drivers = [track.channel for track in tracks if track.is_driver]
        of_contacts = [t for t in tracks if any(generation.kind == CONTACTS for generation in t.generations)]
        if of_contacts:
            self.contacts = np.zeros(self._bins, np.int64)
        for contents in recording.chunks({*drivers, *(track.channel for track in of_contacts)}):
            times_s = [recording.time_s(m.time_ns) for m in contents.messages if m.channel_id in drivers]
            np.add.at(self.samples, [self._bin(time_s) for time_s in times_s], 1)
            for track in of_contacts:
                for time_s, sample in track.samples_in(contents):
                    times_s.append(time_s)
                    at, counts = self._bin(time_s), self.contacts
                    if counts is not None:
                        counts[at] = max(counts[at], int(sample.column("count")[0]))
            self.until_s = max(self.until_s, *times_s, 0.0)
            yield
        self.until_s = recording.duration_s
        yield

    def as_data(self) -> dict[str, Any]:
        return {
            "until_s": self.until_s,
            "samples": self.samples.tolist(),
            "missed": self.missed.tolist(),
            "contacts": None if self.contacts is None else self.contacts.tolist(),
            "events": list(self.events),
        }

    def _bin(self, time_s: float) -> int:
        share = time_s / self._recording.duration_s if self._recording.duration_s else 0.0
        return min(self._bins - 1, max(0, int(share * self._bins)))


class PlayedRecording:
    """A recording that a thread publishes again in a namespace of its own, paused at its begin.

    Attributes:
        began_s: when the recording began, s since 1970.
        state: as :meth:`skinware.recording.replaying.Replayer.replay` returns it.
        outline: of the part so far, as the page reads it; another thread makes it, and replaces it.
        problems: of the file, and why it stopped.
    """

    def __init__(self, file: Path, title: str) -> None:
        import skinware.recording
        from skinware.recording.replaying import Replayer

        self.file, self.title = file, title
        self.namespace = Namespace(f"view-{os.getpid()}-{next(_numbers)}")
        self._recording = skinware.recording.open(file)
        self._replayer = Replayer(self._recording, namespace=self.namespace, paused=True, stays=True)
        self._orders: SimpleQueue[tuple[str, Any, Callable[[str], object]]] = SimpleQueue()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK)
        self._replayer.watch(self._bell, self._obey)
        self._is_over = threading.Event()
        self._failure: str | None = None
        self._of_file = self._recording.problems
        self.began_s: float = self._recording.start_ns / NS_PER_S
        self.state: dict[str, Any] = self._replayer.replay()
        self.outline: dict[str, Any] = {}
        self._threads = [threading.Thread(target=run, name="recording") for run in (self._play, self._make_outline)]
        for thread in self._threads:
            thread.start()

    @property
    def problems(self) -> list[str]:
        found = [*self._of_file, *([self._failure] if self._failure else [])]
        if not self._recording.is_whole:
            found.append("its end is missing; skin-recover completes it")
        return [f"{self.title}: {problem}" for problem in found]

    def act(self, action: str, value: float | bool | None, complain: Callable[[str], object]) -> None:
        self._orders.put((action, value, complain))
        os.eventfd_write(self._bell, 1)

    def close(self) -> None:
        """End the threads, and remove the namespace; that takes as long as a read of some hundred samples."""
        self._is_over.set()
        self._replayer.stop()
        for thread in self._threads:
            thread.join()
        self._replayer.close()
        self._recording.close()
        os.close(self._bell)
        shutil.rmtree(self.namespace.path, ignore_errors=True)

    def _play(self) -> None:
        try:
            self._replayer.run(self._note, _REPORT_EVERY_S)
        except (SkinwareError, OSError) as error:
            self._failure = str(error)

    def _note(self) -> None:
        self.state = self._replayer.replay()

    def _obey(self) -> None:
        os.eventfd_read(self._bell)
        orders = [self._orders.get() for _ in range(self._orders.qsize())]
        for order, following in itertools.zip_longest(orders, orders[1:]):
            action, value, complain = order
            if following is not None and (action, following[0]) == ("seek", "seek"):
                continue  # a person scrubs faster than pictures are made
            try:
                getattr(self._replayer, action)(*([] if value is None else [value]))
            except (TypeError, ValueError) as error:
                complain(str(error))
        self._note()

    def _make_outline(self) -> None:
        import skinware.recording

        try:
            with skinware.recording.open(self.file) as recording:
                outline, due_ns = Outline(recording), 0
                begin_ns = time.monotonic_ns()
                for _ in outline.steps():
                    end_ns = time.monotonic_ns()
                    if end_ns >= due_ns or outline.until_s == recording.duration_s:
                        self.outline, due_ns = outline.as_data(), end_ns + _OUTLINE_EVERY_NS
                    if self._is_over.wait((end_ns - begin_ns) / NS_PER_S):  # half of the time is for the replay
                        return
                    begin_ns = time.monotonic_ns()
                self._of_file = recording.problems
        except (SkinwareError, OSError) as error:
            self._failure = str(error)


class Show:
    """Followed drivers, and the replays that their viewers control.

    Args:
        played: recordings whose namespaces the follower follows; empty: it follows living drivers, among which a
            ``skin-replay`` may be.
    """

    def __init__(
        self, follower: Follower, played: Sequence[PlayedRecording] = (), problems: Sequence[str] = ()
    ) -> None:
        self.follower, self.played = follower, played
        self.due_s = 0.0  # when samples for plots are to be taken again, CLOCK_MONOTONIC
        self.slack_s = follower.slack_s
        self._problems = problems
        self._control = ReplayControl()

    @property
    def is_live(self) -> bool:
        return not self.played and not self._problems

    @property
    def replays(self) -> list[dict[str, Any]]:
        if self.played:
            return [{**one.state, "title": one.title, "began_s": one.began_s} for one in self.played]
        return [] if self._control.state is None else [self._control.state]

    @property
    def outlines(self) -> list[dict[str, Any]]:
        return [played.outline for played in self.played]

    @property
    def problems(self) -> list[str]:
        return [*self._problems, *(problem for played in self.played for problem in played.problems)]

    def follow(self) -> None:
        if self.is_live:
            self._control.follow(self.follower.drivers)

    def act(self, order: Replay, complain: Callable[[str], object]) -> None:
        """Control the replays, or one of them; call ``complain`` with the reason if that fails, perhaps by a thread."""
        if order.action not in REPLAY_VALUES:
            raise ConfigurationError("no replay is shown")
        if not self.played:
            self._control.act(order.action, order.value, complain)
        for number, played in enumerate(self.played):
            if order.number in (None, number):
                played.act(order.action, order.value, complain)

    def close(self) -> None:
        self.follower.close()
        for played in self.played:
            played.close()


class RecordingFiles:
    """The recordings that viewers may see: some files, and all others in their folders."""

    def __init__(self, files: Sequence[Path] = (), folder: Path | None = None, names: Sequence[str] = ()) -> None:
        self._files = {str(file): file for file in files}
        self._folders = list(dict.fromkeys([folder or Path(), *(file.parent for file in files)]))
        self._names = names

    def find(self, name: str) -> Path | None:
        """Return the file of a recording as an address names it: as it was chosen, or by its name without a folder."""
        if name in self._files:
            return self._files[name]
        if Path(name).name != name or not name.endswith(SUFFIX):
            return None
        return next((folder / name for folder in self._folders if (folder / name).is_file()), None)

    def open(self, names: Sequence[str]) -> Show:
        """Return a show of recordings, beside each other; it says itself which of them cannot be shown."""
        played: list[PlayedRecording] = []
        problems = [f"at most {MOST_BESIDE} recordings are shown at once"] * (len(names) > MOST_BESIDE)
        stems = [Path(name).stem for name in names]
        for number, name in enumerate(names[:MOST_BESIDE]):
            title = stems[number] if stems.count(stems[number]) == 1 else f"{stems[number]} {number + 1}"
            file = self.find(name)
            try:
                if file is None:
                    raise ConfigurationError(f"{name}: there is no such file where skin-view was started")
                played.append(PlayedRecording(file, title))
            except SkinwareError as error:
                problems.append(str(error))
            except OSError as error:
                problems.append(f"{name}: {error.strerror or error}")
        are_beside = len(played) > 1
        origins = [Origin(one.namespace, self._names, recording=one.title, is_beside=are_beside) for one in played]
        return Show(Follower(*origins), played, problems)
