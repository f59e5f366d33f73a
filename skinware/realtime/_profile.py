"""Keep a loop on time: scheduling policy, locked memory, CPUs, timer slack, and no garbage collection."""

from __future__ import annotations

import gc
import logging
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Self

from skinware.errors import ConfigurationError, RealtimeRefused
from skinware.realtime import _kernel
from skinware.realtime._kernel import cpus_as_text, online_cpus

log = logging.getLogger("skinware.realtime")

_HIGHEST_PRIORITY = 99


@dataclass(frozen=True, kw_only=True)
class Profile:
    """How the kernel and Python are to treat the loop of this thread; begin with :meth:`normal` or :meth:`fifo`.

    Attributes:
        policy: ``fifo`` (SCHED_FIFO: runs before every normal thread of its CPU until it waits) or ``normal``.
        priority: 1 (lowest) to 99 for ``fifo``, 0 for ``normal``.
        cpus: the only CPUs to run on; empty changes nothing.
        lock_memory: keep all memory that this process uses in RAM; False changes nothing.
        timer_slack_ns: by how much the kernel may delay timers to save wake-ups, 1 or more; Linux starts processes
            with 50000. ``fifo`` has none in any case, so there it counts only if ``fifo`` is refused.
        freeze_gc: collect garbage once, and exclude all objects that exist then from later collections.

    Raises:
        ConfigurationError: a priority that does not fit the policy, a CPU that is not there, or a slack below 1 ns.
    """

    policy: Literal["normal", "fifo"] = "normal"
    priority: int = 0
    cpus: tuple[int, ...] = ()
    lock_memory: bool = False
    timer_slack_ns: int = 1
    freeze_gc: bool = True

    def __post_init__(self) -> None:
        if self.policy not in ("normal", "fifo"):
            raise ConfigurationError(f"scheduling policy {self.policy!r}: give normal or fifo")
        if self.policy == "fifo" and not 1 <= self.priority <= _HIGHEST_PRIORITY:
            raise ConfigurationError(f"fifo priority {self.priority}: give 1 (lowest) to {_HIGHEST_PRIORITY}")
        if self.policy == "normal" and self.priority:
            raise ConfigurationError(f"priority {self.priority}: normal scheduling has none; fifo has")
        if self.timer_slack_ns < 1:
            raise ConfigurationError(f"timer slack of {self.timer_slack_ns} ns: give 1 or more")
        there = online_cpus()
        for cpu in self.cpus:
            if cpu not in there:
                raise ConfigurationError(f"CPU {cpu} is not there; this machine has {cpus_as_text(there)}")

    @classmethod
    def normal(cls, *, cpus: Iterable[int] = ()) -> Self:
        """Return the kernel's ordinary scheduling with exact timers and frozen garbage: needs no rights.

        Raises:
            ConfigurationError: a CPU that is not there.
        """
        return cls(cpus=tuple(cpus))

    @classmethod
    def fifo(cls, priority: int, *, cpus: Iterable[int] = ()) -> Self:
        """SCHED_FIFO and locked memory, for a program with one Python thread that mostly waits.

        Raises:
            ConfigurationError: a priority outside 1 to 99, or a CPU that is not there.
        """
        return cls(policy="fifo", priority=priority, cpus=tuple(cpus), lock_memory=True)

    @classmethod
    def from_text(cls, text: str, *, cpus: Iterable[int] = ()) -> Self:
        """Return a profile as people write it: ``normal`` or ``fifo:PRIORITY``.

        Raises:
            ConfigurationError: the text is neither, or the priority or a CPU cannot be.
        """
        if text == "normal":
            return cls.normal(cpus=cpus)
        match = re.fullmatch(r"fifo:(\d{1,3})", text, re.ASCII)
        if match is None:
            raise ConfigurationError(f"real-time profile {text!r}: give normal or fifo:PRIORITY, as fifo:50")
        return cls.fifo(int(match[1]), cpus=cpus)

    def apply(self, *, strict: bool = False) -> tuple[_kernel.Refusal, ...]:
        """Put the calling thread, and for memory and garbage the whole process, under this profile.

        Call it in the thread that runs the loop. Threads and child processes that it starts afterwards inherit policy,
        CPUs and timer slack; those that exist already keep their own. Child processes do not inherit locked memory.

        What the kernel refuses for lack of rights is left as it was, and the rest is done, whatever ``strict`` says.

        Args:
            strict: raise if anything is refused, instead of one warning for each on the logger ``skinware.realtime``.

        Returns:
            What was refused; empty if all was granted.

        Raises:
            RealtimeRefused: something was refused, and ``strict`` is set.
        """
        answers = [_kernel.set_cpus(self.cpus) if self.cpus else None]
        if self.freeze_gc:
            gc.collect()
            gc.freeze()
        answers.append(_kernel.lock_memory() if self.lock_memory else None)
        answers.append(_kernel.set_policy(self.priority))
        if not _kernel.is_fifo():
            _kernel.set_timer_slack(self.timer_slack_ns)  # after the policy, whose change resets it
        refusals = tuple(answer for answer in answers if answer is not None)
        if refusals and strict:
            raise RealtimeRefused("\n".join(str(refusal) for refusal in refusals))
        for refusal in refusals:
            log.warning("%s", refusal)
        return refusals
