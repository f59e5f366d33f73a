"""Walk over a device: ask a person to press and stroke its modules, and judge the values."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import RequestError, RequestRefused, StructureError
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.text import figure_text, measure_text, plural, words
from skinware.views.live import after, frames_until
from skinware_drivers.proving.proof import Proof, Verdict
from skinware_drivers.proving.strokes import Matrix, judge

Values = npt.NDArray[np.float64]
Wanted = Literal["rest", "press", "let go", "stroke down", "stroke across"]

_FIRST_CHOICE = ("pressure", "force")
_TIMES_THE_NOISE = 8.0
_HELD_FRAMES = 4
_LEAST_RATE = 0.9
_LIFTED_S = 0.3
_MOST_NAMES = 6
_TARE = "tare"
_UNUSABLE = int(Status.NEVER_SEEN | Status.STALE | Status.MASKED)


class Step(NamedTuple):
    wanted: Wanted
    module: str
    text: str


class Person(Protocol):
    def ask(self, step: Step) -> None:
        """Show a request, without waiting."""

    def skips(self) -> bool:
        """Return whether the person has asked to leave this module out, since the last call."""


@dataclass(frozen=True)
class Manner:
    """Settings of a walk.

    Attributes:
        only: press the modules with one of these words in their names; empty: all.
    """

    type_name: str | None = None
    only: Sequence[str] = ()
    patience_s: float = 30.0
    rest_s: float = 3.0
    with_tare: bool = False


class _Missed(Exception):
    """A step was not done in time: the check without an answer, and why."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(why)
        self.what = what


class _Skipped(Exception):
    """The person leaves the module out."""


def walk(reader: DriverReader, person: Person, manner: Manner, proof: Proof) -> None:
    """Check all modules, and add the checks to a proof, which is valid also if the walk is interrupted.

    Raises:
        ServiceTimeout: no snapshot came for 5 s.
        StructureChanged: the driver has other sensors now.
        StructureError: the driver has no sensors of this type, or no such module.
    """
    _Walk(reader, person, manner, proof).go()


class _Walk:
    def __init__(self, reader: DriverReader, person: Person, manner: Manner, proof: Proof) -> None:
        self._reader, self._person, self._manner, self._proof = reader, person, manner, proof
        structure = self._structure = reader.structure
        names = [one.name for one in structure.types]
        chosen = manner.type_name or next((name for name in _FIRST_CHOICE if name in names), names[0])
        self._type = structure.type(chosen)
        module = structure.module_of(chosen)
        self._modules = [
            int(number)
            for number in np.unique(module)
            if any(word.lower() in self._structure.module_names[int(number)].lower() for word in manner.only or [""])
        ]
        if not self._modules:
            raise StructureError(
                f"no module of {reader.name} has such a name; its modules: {', '.join(self._structure.module_names)}"
            )
        self._taxels = {int(number): np.flatnonzero(module == number) for number in np.unique(module)}
        self._rest: Values = np.zeros(0)
        self._low: Values = np.full(len(module), np.inf)
        self._high: Values = np.full(len(module), -np.inf)
        self._usable = np.zeros(len(module), bool)
        self._threshold = 0.0
        self._first: DriverSnapshot | None = None
        self._last: DriverSnapshot | None = None

    def go(self) -> None:
        self._proof.about["sensors"] = f"{self._structure.n_sensors}, judged by {self._type.name} ({self._type.unit})"
        try:
            self._check_rest()
            for module in self._modules:
                name = self._structure.module_names[module]
                kind = bytes(self._structure.module_kind[module]).decode()
                try:
                    self._press(module)
                    matrix = Matrix.of_kind(kind, len(self._taxels[module]))
                    if matrix is not None:
                        self._stroke(module, matrix)
                except _Skipped:
                    self._proof.add("right module", name, Verdict.SKIPPED, "not wanted")
                except _Missed as missed:
                    self._proof.add(missed.what, name, False, f"{missed} within {self._manner.patience_s:g} s")
            self._tare()
        finally:
            self._check_losses()

    def _tare(self) -> None:
        try:
            if _TARE not in self._reader.operations():
                return
        except RequestRefused:  # it takes no requests at all
            return
        if not self._manner.with_tare:
            self._proof.add("tare", "", Verdict.UNKNOWN, "not wanted (--tare)")
            return
        self._person.ask(Step("rest", "", "leave the device alone"))
        try:
            self._reader.call(_TARE)
            values = [values for _, values in self._frames(after(self._manner.rest_s))]
        except RequestError as error:
            self._proof.add("tare", "", False, str(error))
        except _Skipped:
            self._proof.add("tare", "", Verdict.SKIPPED, "not wanted")
        else:
            left = float(np.abs(values[-1][self._usable]).max()) if values and self._usable.any() else np.nan
            seen = f"at most {measure_text(left, self._type.unit, 3)} is left"
            self._proof.add("tare", "", left <= self._threshold, seen)

    # -- at rest --------------------------------------------------------------------------------------------------

    def _check_rest(self) -> None:
        self._person.ask(Step("rest", "", "leave the device alone"))
        frames, stamps = [], []
        for frame, values in self._frames(after(self._manner.rest_s), may_skip=False):
            frames.append(values)
            stamps.append(frame.module_time_ns.copy())
        if len(frames) < 2:
            raise StructureError(f"{self._reader.name} publishes too few snapshots to judge")
        all_values = np.array(frames)
        self._rest = np.median(all_values, axis=0)
        count = abs(self._type.scale) if self._structure.dtype.kind != "f" else 0.0
        unrest = np.abs(all_values - self._rest).max(axis=0)
        noise = max(float(np.median(unrest[self._usable])) if self._usable.any() else 0.0, count)
        self._threshold = _TIMES_THE_NOISE * noise if noise else 1e-6
        unit = self._type.unit
        missing = np.flatnonzero(~self._usable)
        without_data = plural(len(self._usable), "taxel")
        if len(missing):
            names = self._structure.sensor_names(self._type.name)
            more = f" and {len(missing) - _MOST_NAMES} more" if len(missing) > _MOST_NAMES else ""
            without_data = f"none from {', '.join(names[taxel] for taxel in missing[:_MOST_NAMES])}{more}"
        self._proof.add("every taxel has data", "", not len(missing), without_data)
        self._proof.about["noise"] = (
            f"{figure_text(noise, 3)} {unit}; pressed is more than {figure_text(self._threshold, 3)}"
        )
        self._check_rate(np.array(stamps))

    def _check_rate(self, stamps: npt.NDArray[np.int64]) -> None:
        """Check the rate of updates; snapshots that were missed count like those that were read."""
        first, last = self._first, self._last
        if first is None or last is None or last.published_ns == first.published_ns:
            return
        frames_hz = (last.sequence - first.sequence) / (last.published_ns - first.published_ns) * NS_PER_S
        for module in self._taxels:
            rate_hz = frames_hz * float(np.mean(np.diff(stamps[:, module]) != 0))
            if not last.period_ns:
                self._proof.add(
                    "rate", self._structure.module_names[module], Verdict.UNKNOWN, f"{rate_hz:.1f} a second"
                )
                continue
            nominal_hz = NS_PER_S / last.period_ns
            is_right = rate_hz >= _LEAST_RATE * nominal_hz
            self._proof.add(
                "rate", self._structure.module_names[module], is_right, f"{rate_hz:.1f} of {nominal_hz:.1f} a second"
            )

    def _check_losses(self) -> None:
        if self._first is None or self._last is None:
            return
        before, now = self._reader.bus_counters(self._first), self._reader.bus_counters(self._last)
        for bus, (old, new) in enumerate(zip(before, now, strict=True)):
            grown = {name: new[name] - old.get(name, 0) for name in new if name in _LOSSES}
            lost = ", ".join(f"{count} {words(name)}" for name, count in grown.items() if count)
            self._proof.add("losses", f"bus {bus}", not any(grown.values()), lost or "none")

    # -- touched --------------------------------------------------------------------------------------------------

    def _press(self, module: int) -> None:
        name, taxels = self._structure.module_names[module], self._taxels[module]
        self._person.ask(Step("press", name, f"press {name}, and hold"))
        held: deque[int] = deque(maxlen=_HELD_FRAMES)
        most, signed, values, frame = 0, 0.0, self._rest, None
        for frame, values in self._patiently("right module", "nothing was felt"):  # noqa: B007 - the last one counts
            change = values - self._rest
            most = int(np.nanargmax(np.abs(change)))
            module_of_most = int(self._structure.module_of(self._type.name)[most])
            held.append(module_of_most if abs(change[most]) > self._threshold else -1)
            if len(held) == _HELD_FRAMES and len(set(held)) == 1 and held[0] >= 0:
                signed = float(change[most])
                break
        answered = held[-1]
        where = f"{self._structure.sensor_names(self._type.name)[most]} by {measure_text(signed, self._type.unit, 3)}"
        self._proof.add("right module", name, answered == module, where)
        self._proof.add("sign", name, signed > 0, "grows" if signed > 0 else "goes down when it is pressed")
        self._check_range(name, values[taxels], frame)
        self._person.ask(Step("let go", name, f"let go of {name}"))
        for _, values in self._patiently("comes to rest", "some taxels did not"):
            if np.nanmax(np.abs(values - self._rest)) <= self._threshold:
                break

    def _check_range(self, name: str, values: Values, frame: DriverSnapshot | None) -> None:
        flagged = 0
        if frame is not None:
            status = frame.status_of(self._type.name)
            flagged = int(np.count_nonzero(status & np.uint8(Status.OUT_OF_RANGE)))
        least, most = self._type.minimum, self._type.maximum
        full = int(np.count_nonzero(values >= most)) if most > least else 0
        if flagged or full:
            text = f"{plural(max(flagged, full), 'taxel')} at the end of the range: press less"
            self._proof.add("saturation", name, Verdict.UNKNOWN, text)
        else:
            self._proof.add("saturation", name, True, "none at the end of the range")

    def _stroke(self, module: int, matrix: Matrix) -> None:
        name, taxels = self._structure.module_names[module], self._taxels[module]
        down = self._stroked(module, "stroke down", f"{name}: stroke slowly from the fingertip down, then lift")
        across = self._stroked(
            module, "stroke across", f"{name}: stroke slowly from left to right (fingers up, palm to you), then lift"
        )
        order = judge(matrix, down, across, self._threshold)
        said = [*order.wrong, *order.misplaced]
        enough = 2 * order.judged >= len(taxels)
        seen = "; ".join(said) or f"{order.judged} of {len(taxels)} taxels in order"
        if said or enough:
            self._proof.add("order of taxels", name, not said, seen)
        else:
            self._proof.add("order of taxels", name, Verdict.UNKNOWN, f"only {seen}: stroke over all of it")
        silent = [taxel for taxel in order.silent if self._usable[taxels[taxel]]]
        for taxel in silent[:_MOST_NAMES]:
            place = int(taxels[taxel])
            constant = self._low[place] == self._high[place]
            text = f"always {figure_text(float(self._low[place]), 4)}" if constant else "moves only by noise"
            self._proof.add("taxel answers", f"{name}, taxel {taxel}", False, text)
        if not silent and enough:
            self._proof.add("taxel answers", name, True, f"all {len(taxels)}")
        elif len(silent) > _MOST_NAMES:
            self._proof.add("taxel answers", name, False, f"{len(silent)} in all did not")

    def _stroked(self, module: int, wanted: Wanted, text: str) -> Values:
        """Return (frames, n): distances of a module's taxels from their rest, from the first touch until the lift."""
        self._person.ask(Step(wanted, self._structure.module_names[module], text))
        taxels = self._taxels[module]
        found: list[Values] = []
        lifted_ns: int | None = None
        for frame, values in self._patiently("order of taxels", "no stroke was felt"):
            change = np.abs(values[taxels] - self._rest[taxels])
            if change.max() > self._threshold:
                found.append(change)
                lifted_ns = None
            elif found:
                lifted_ns = lifted_ns or frame.published_ns
                if frame.published_ns - lifted_ns > _LIFTED_S * NS_PER_S:
                    break
        return np.array(found)

    # -- frames ---------------------------------------------------------------------------------------------------

    def _patiently(self, what: str, else_: str) -> Iterator[tuple[DriverSnapshot, Values]]:
        """Yield snapshots as :meth:`_frames` does; raise :class:`_Missed` when the patience ends."""
        yield from self._frames(after(self._manner.patience_s))
        raise _Missed(what, else_)

    def _frames(self, is_over: Callable[[], bool], *, may_skip: bool = True) -> Iterator[tuple[DriverSnapshot, Values]]:
        """Yield snapshots with (n,) physical values of the type; taxels without data have their values at rest."""
        for frame in frames_until(self._reader, is_over):
            if self._person.skips() and may_skip:
                raise _Skipped
            usable = (frame.status_of(self._type.name) & np.uint8(_UNUSABLE)) == 0
            values = frame.physical(self._type.name).astype(np.float64)
            if len(self._rest):
                values = np.where(usable & np.isfinite(values), values, self._rest)
            self._usable |= usable
            np.minimum(self._low, values, out=self._low)
            np.maximum(self._high, values, out=self._high)
            self._first = self._first or frame
            self._last = frame
            yield frame, values


_LOSSES = ("dropped", "errors", "overflows", "checksum_errors", "skipped_bytes", "bus_offs", "polls_unanswered", "gaps")
"""Counters of losses and damage on a bus."""
