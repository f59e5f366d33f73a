"""Questions to devices that only answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from skinware.errors import ConfigurationError
from skinware_drivers.bus import identifier_text
from skinware_drivers.link import Match


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
