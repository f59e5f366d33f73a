"""Declare what a driver wants done beside decoding: polls of devices, watches of updates, notices."""

from __future__ import annotations

import enum
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware_drivers.bus import identifier_text
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.link import Match


class Notice(enum.Enum):
    """What a device reports about itself, besides its data."""

    RESTARTED = "restarted"
    """It lost its configuration: ``revive`` is called for it, and for it alone."""
    CHANGED = "changed"
    """It is not what it was described as (another device was plugged in, new firmware): ``join`` is called."""
    LOST = "lost"
    """It is not there, or not in a state to send: stale, until data comes."""
    SUSPECT = "suspect"
    """It reports an error: all its values are suspect, until it is sound or was set up anew."""
    SOUND = "sound"
    """The error is over."""


@dataclass(frozen=True)
class Poll:
    """A request that is sent periodically, so that a device answers with data.

    Without ``answer`` it is sent every ``period_s``, whatever comes back. With ``answer`` it is sent *in lock step*:
    nothing else is sent on this bus until the answer has arrived, or ``timeout_s`` has passed.

    Attributes:
        identifier: of the frame.
        payload: of the frame.
        period_s: time from one to the next, s.
        answer: which frames answer it; they may be data.
        timeout_s: how long to wait for it, s; default: ``period_s``.

    Raises:
        ConfigurationError: a period or timeout that is not above 0, or a timeout without an answer.
    """

    identifier: int
    payload: bytes
    period_s: float
    answer: Match | None = None
    timeout_s: float | None = None

    def __post_init__(self) -> None:
        name = self.name
        if not self.period_s > 0:
            raise ConfigurationError(f"{name} every {self.period_s} s: give more than 0")
        if self.timeout_s is not None and self.answer is None:
            raise ConfigurationError(f"{name} has a timeout and no `answer` to wait for: say which frames answer it")
        if self.timeout_s is not None and not self.timeout_s > 0:
            raise ConfigurationError(f"{name} waits {self.timeout_s} s for its answer: give more than 0")

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"poll {identifier_text(self.identifier)}"

    @property
    def patience_s(self) -> float:
        """How long its answer is waited for, s."""
        return self.timeout_s or self.period_s


def check_polls(polls: Sequence[Poll], wire_s: Callable[[Poll], float]) -> str:
    """Refuse polls that cannot be answered in time.

    Args:
        polls: those of one bus.
        wire_s: how long question and answer of one take on the line at least, s; 0 where that is not known.

    Returns:
        What is doubtful about them, for people; empty if nothing is.

    Raises:
        ConfigurationError: one cannot be answered before its timeout.
    """
    load = 0.0
    doubts = []
    for poll in polls:
        needed_s = wire_s(poll)
        load += needed_s / poll.period_s
        if poll.answer is None:
            continue
        if needed_s > poll.patience_s:
            raise ConfigurationError(
                f"{poll.name} waits {_ms(poll.patience_s)} for its answer, but question and answer alone take"
                f" {_ms(needed_s)} on the line: make timeout_s longer, or the line faster (baudrate)"
            )
        if len(polls) > 1 and poll.patience_s > poll.period_s:
            doubts.append(
                f"{poll.name} waits {_ms(poll.patience_s)} for its answer, longer than its period of"
                f" {_ms(poll.period_s)}: if its device is silent, the others miss their turns; make timeout_s shorter"
            )
    if load > 1:
        doubts.append(
            f"all questions and answers take {100 * load:.0f} % of the time that their periods leave on the line: ask"
            " for less, make the periods longer, or the line faster (baudrate)"
        )
    return "; ".join(doubts)


def _ms(time_s: float) -> str:
    return f"{time_s * 1e3:.3g} ms"


class Watch:
    """Sees every update of all buses and marks doubtful values that no single frame shows as such.

    Attributes:
        module_status: (n_modules,) uint8, status bits added to every sensor of a module at publication.
        module_untouched: (n_modules,) bool, modules of which nothing shows yet that they live; for people, their values
            count as fresh.
        sees_all: ``look`` is called with all updates; it may be set to False as soon as that is not needed any more.
    """

    sees_all: bool = False

    def __init__(self, tables: SkinTables) -> None:
        self.tables = tables
        self.module_status: npt.NDArray[np.uint8] = np.zeros(tables.structure.n_modules, np.uint8)
        self.module_untouched: npt.NDArray[np.bool_] = np.zeros(tables.structure.n_modules, bool)

    def look(self, updates: Updates) -> None:
        """Called with updates that were just shown, if the wire may have flagged one of them, or it ``sees_all``.

        Of an update, what has no sensor (``updates.sensors`` is ``n_sensors``) has no meaning.
        """

    def suspect(self, patch: int) -> None:
        """Called when a patch reports an error."""
        self.module_status[self.tables.structure.module_patch == patch] |= np.uint8(Status.SUSPECT)

    def forget(self, patch: int) -> None:
        """Called when a patch was set up anew, or reports no error any more: what was held against it is over."""
        self.module_status[self.tables.structure.module_patch == patch] = 0


log: logging.Logger = logging.getLogger("skinware.driver")

_MOST_NAMES = 6


class ZeroWatch(Watch):
    """Knows which modules have sent nothing but 0 since they were first heard: not touched yet, or dead.

    Their values are good and fresh: hands whose taxels rest at exactly 0 are usual. What is known is published as
    :attr:`skinware.DriverSnapshot.module_untouched`. After the first other value, a module counts as alive for good.

    Attributes:
        patience_s: for how long 0 comes before the log names a module.
    """

    patience_s: float = 10.0

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        n_modules = tables.structure.n_modules
        self._is_dark: npt.NDArray[np.bool_] = np.ones(n_modules, bool)
        self._since_ns: npt.NDArray[np.int64] = np.zeros(n_modules, np.int64)  # 0: not heard yet
        self._is_told: npt.NDArray[np.bool_] = np.zeros(n_modules, bool)
        self.sees_all = True

    def look(self, updates: Updates) -> None:
        """See which modules sent another value than 0."""
        time_ns, whole = int(updates.newest_ns.max()), updates.module[updates.whole]
        self._since_ns[whole] = np.where(self._since_ns[whole] == 0, time_ns, self._since_ns[whole])
        lit = ((updates.values != 0) & (updates.sensors < self.tables.structure.n_sensors)).any(axis=1)
        self._is_dark[updates.module[lit]] = False
        self.module_untouched[:] = self._is_dark & (self._since_ns > 0)
        self._name(time_ns)
        self.sees_all = bool(self._is_dark.any())

    def forget(self, patch: int) -> None:
        """The patch was set up again: its modules have to show again that they live."""
        super().forget(patch)
        modules = self.tables.structure.module_patch == patch
        self._is_dark[modules], self._since_ns[modules], self._is_told[modules] = True, 0, False
        self.module_untouched[modules] = False
        self.sees_all = True

    def _name(self, time_ns: int) -> None:
        has_waited = self.module_untouched & (time_ns - self._since_ns >= self.patience_s * NS_PER_S)
        untold = np.flatnonzero(has_waited & ~self._is_told)
        if len(untold) and (has_waited == self.module_untouched).all():  # not one by one
            self._is_told[untold] = True
            names = [self.tables.structure.module_names[module] for module in untold[:_MOST_NAMES].tolist()]
            more = f" and {len(untold) - len(names)} more" if len(untold) > len(names) else ""
            log.info("nothing but 0 has come from %s%s so far: not touched yet, or dead", "; ".join(names), more)
