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
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import Match


class Notice(enum.Enum):
    """A report of a device about itself, beside its data."""

    RESTARTED = "restarted"
    """The device lost its configuration: ``revive`` is called for it alone."""
    CHANGED = "changed"
    """The device differs from its description (another device, new firmware): ``join`` is called."""
    LOST = "lost"
    """The device is absent, or cannot send: stale, until data comes."""
    SUSPECT = "suspect"
    """The device reports an error: all its values are suspect until it is sound, or was set up again."""
    SOUND = "sound"
    """The error is over."""


@dataclass(frozen=True)
class Poll:
    """A request that is sent periodically; the device answers with data.

    Without ``answer`` it is sent every ``period_s``, whatever comes back. With ``answer`` it is sent *in lock step*:
    nothing else is sent on this bus until the answer has arrived, or ``timeout_s`` has passed.

    Attributes:
        identifier: of the frame.
        payload: of the frame.
        period_s: time from one to the next, s.
        answer: the frames that answer it; they may be data.
        timeout_s: time to wait for the answer, s; default: ``period_s``.

    Raises:
        ConfigurationError: the period or timeout is not above 0, or there is a timeout without ``answer``.
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
        """Its name in messages."""
        return f"poll {identifier_text(self.identifier)}"

    @property
    def patience_s(self) -> float:
        """Time to wait for its answer, s."""
        return self.timeout_s or self.period_s


def check_polls(polls: Sequence[Poll], wire_s: Callable[[Poll], float]) -> str:
    """Refuse polls that cannot be answered in time.

    Args:
        wire_s: returns the least time that question and answer take on the line, s; 0 if it is not known.

    Returns:
        Doubts about them, for people; empty if there are none.

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
    """Looks at the updates of all buses and marks doubtful values that no single frame shows.

    Attributes:
        module_status: (n_modules,) uint8, status bits added to every sensor of a module at publication.
        module_untouched: (n_modules,) bool, modules that have not shown yet that they live; their values are fresh.
        sees_all: whether ``look`` is called with all updates; set it to False when that is no longer needed.
    """

    sees_all: bool = False

    def __init__(self, tables: SkinTables) -> None:
        self.tables = tables
        self.module_status: npt.NDArray[np.uint8] = np.zeros(tables.structure.n_modules, np.uint8)
        self.module_untouched: npt.NDArray[np.bool_] = np.zeros(tables.structure.n_modules, bool)

    def look(self, updates: Updates) -> None:
        """Look at updates that were just shown; called if one of them may have a flag, or the watch ``sees_all``.

        Values without a sensor (``updates.sensors`` is ``n_sensors``) have no meaning.
        """

    def suspect(self, patch: int) -> None:
        """Mark all modules of a patch as suspect; called when the patch reports an error."""
        self.module_status[self.tables.structure.module_patch == patch] |= np.uint8(Status.SUSPECT)

    def forget(self, patch: int) -> None:
        """End all doubts about a patch; called when it was set up again, or reports that its error is over."""
        self.module_status[self.tables.structure.module_patch == patch] = 0


log: logging.Logger = logging.getLogger("skinware.driver")

_MOST_NAMES = 6


class ZeroWatch(Watch):
    """Marks modules that have sent only 0 since they were first heard: not touched yet, or dead.

    Their values are good and fresh: the taxels of many hands rest at exactly 0. The marks are published as
    :attr:`skinware.DriverSnapshot.module_untouched`. After its first other value, a module counts as alive.

    Attributes:
        patience_s: time in which only 0 must come before the log names a module.
    """

    patience_s: float = 10.0

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        n_modules = tables.structure.n_modules
        self._is_dark: npt.NDArray[np.bool_] = np.ones(n_modules, bool)
        self._since_ns: npt.NDArray[np.int64] = np.zeros(n_modules, np.int64)  # 0: not heard yet
        self._is_named: npt.NDArray[np.bool_] = np.zeros(n_modules, bool)
        self.sees_all = True

    def look(self, updates: Updates) -> None:
        """Unmark modules that sent another value than 0."""
        time_ns, whole = int(updates.newest_ns.max()), updates.module[updates.whole]
        self._since_ns[whole] = np.where(self._since_ns[whole] == 0, time_ns, self._since_ns[whole])
        lit = ((updates.values != 0) & (updates.sensors < self.tables.structure.n_sensors)).any(axis=1)
        self._is_dark[updates.module[lit]] = False
        self.module_untouched[:] = self._is_dark & (self._since_ns > 0)
        self.sees_all = bool(self._is_dark.any())
        has_waited = self.module_untouched & (time_ns - self._since_ns >= self.patience_s * NS_PER_S)
        unnamed = np.flatnonzero(has_waited & ~self._is_named)
        if len(unnamed) and (has_waited == self.module_untouched).all():  # not one by one
            self._is_named[unnamed] = True
            names = [self.tables.structure.module_names[module] for module in unnamed[:_MOST_NAMES].tolist()]
            more = f" and {len(unnamed) - len(names)} more" if len(unnamed) > len(names) else ""
            log.info("nothing but 0 has come from %s%s so far: not touched yet, or dead", "; ".join(names), more)

    def forget(self, patch: int) -> None:
        """End all doubts about a patch; its modules must show again that they live."""
        super().forget(patch)
        modules = self.tables.structure.module_patch == patch
        self._is_dark[modules], self._since_ns[modules], self._is_named[modules] = True, 0, False
        self.module_untouched[modules] = False
        self.sees_all = True
