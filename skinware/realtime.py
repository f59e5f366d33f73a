"""Time, periods and scheduling: CLOCK_MONOTONIC in ns, absolute deadlines, and what keeps a loop on time.

::

    from skinware.realtime import Periodic, Profile

    Profile.fifo(50, cpus=[1]).apply()  # before any other thread is started
    for _ in Periodic(rate_hz=1000):
        ...

A lack of rights is no error when the kernel is asked: it comes back in words.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import pwd
import re
import resource
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from errno import EINVAL, EPERM
from pathlib import Path
from typing import Literal, Self

from skinware.errors import ConfigurationError, RealtimeRefused

__all__ = [
    "NS_PER_S",
    "TURN_S",
    "WAIT_SLICE_NS",
    "Periodic",
    "Profile",
    "Refusal",
    "boot",
    "cpus_from_text",
    "now_ns",
    "period_ns",
    "short_turns",
]

NS_PER_S = 1_000_000_000

WAIT_SLICE_NS = 50_000_000
"""No wait in this package lasts longer than this without looking around (signals, close, a dead peer)."""


def now_ns() -> int:
    """CLOCK_MONOTONIC in ns: the time base of every sample."""
    return time.monotonic_ns()


def boot() -> str:
    """Return which start of the machine CLOCK_MONOTONIC counts from: a number that no other start has."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


def period_ns(rate_hz: float) -> int:
    """Period of a rate.

    Raises:
        ConfigurationError: the rate is not above 0 and at most 100 kHz.
    """
    if not 0 < rate_hz <= 100_000:
        raise ConfigurationError(f"rate of {rate_hz} Hz: give more than 0 and at most 100000")
    return max(1, round(NS_PER_S / rate_hz))


class Periodic:
    """Absolute deadlines of a periodic loop: no drift, and no catch-up burst after a late period.

    Attributes:
        missed: periods that were skipped because the loop came back too late.
        deadline_ns: the next deadline.
    """

    def __init__(self, rate_hz: float, start_ns: int | None = None) -> None:
        self.period_ns: int = period_ns(rate_hz)
        self.deadline_ns: int = (now_ns() if start_ns is None else start_ns) + self.period_ns
        self.missed: int = 0

    def advance(self, time_ns: int) -> None:
        """Move to the first deadline after ``time_ns``; those that are jumped over count as missed."""
        late = max(0, time_ns - self.deadline_ns) // self.period_ns
        self.missed += late
        self.deadline_ns += (late + 1) * self.period_ns

    def wait(self, stopped: Callable[[], bool] = lambda: False) -> bool:
        """Sleep until the deadline, then move on to the next one.

        Args:
            stopped: asked at least every 50 ms; True ends the wait.

        Returns:
            False if ``stopped`` said so before the deadline.
        """
        while True:
            if stopped():
                return False
            remaining_ns = self.deadline_ns - now_ns()
            if remaining_ns <= 0:
                break
            time.sleep(min(remaining_ns, WAIT_SLICE_NS) / NS_PER_S)
        self.advance(now_ns())
        return True

    def __iter__(self) -> Iterator[int]:
        """Yield 0, 1, 2 ... one per period."""
        count = 0
        while self.wait():
            yield count
            count += 1


TURN_S = 1e-4
_before_s: list[float] = []


@contextmanager
def short_turns() -> Iterator[None]:
    """Let no thread keep the interpreter for longer than ``TURN_S`` when another wants it; Python's default is 5 ms.

    Beside a thread that computes, whoever lets go of the interpreter waits that long for it: a reader after each sleep,
    a driver dozens of times for a batch (numpy lets go for arrays of some length, and so do system calls). That is too
    long for a ring of 8 slots at 1 kHz, or the receive buffer of a fast bus (docs/benchmarks.md). It holds for the
    whole process, until the last one has ended.
    """
    _before_s.append(sys.getswitchinterval())
    sys.setswitchinterval(min(TURN_S, _before_s[-1]))
    try:
        yield
    finally:
        sys.setswitchinterval(_before_s.pop())


# the same numbers on x86-64, aarch64 and riscv64; mlockall(2), prctl(2), capabilities(7)
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_TIMERSLACK = 29
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23

_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Refusal:
    """One thing that the kernel refused, in words; as text it is one line.

    Attributes:
        what: what was asked for.
        why: the limit, capability or setting that prevents it.
        remedy: what a person can do about it.
    """

    what: str
    why: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.what} refused: {self.why}; {self.remedy}"


def set_policy(priority: int) -> Refusal | None:
    """SCHED_FIFO of a priority for this thread, or ordinary scheduling for 0."""
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    keep = os.sched_getscheduler(0) & os.SCHED_RESET_ON_FORK  # who has no rights may not take this flag off again
    try:
        os.sched_setscheduler(0, policy | keep, os.sched_param(priority))
    except PermissionError:
        what = f"SCHED_FIFO priority {priority}" if priority else "normal scheduling"
        if _has_capability(_CAP_SYS_NICE):
            why = "this process has CAP_SYS_NICE, so its container or control group forbids it"
            return Refusal(what, why, 'allow it there, see "Keep a loop on time" in the documentation')
        limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
        return Refusal(what, f"RLIMIT_RTPRIO is {limit} without CAP_SYS_NICE", _limits_line(f"rtprio {priority}"))
    return None


def lock_memory() -> Refusal | None:
    """Keep in memory what this process has touched or will touch.

    MCL_ONFAULT, because a Python process reserves far more than it touches (thread stacks, numpy's buffers), all of
    which would be filled otherwise. A finite limit is refused even if it is large enough for now: all later
    allocations beyond it would fail.
    """
    what = "locked memory"
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and not _has_capability(_CAP_IPC_LOCK):
        why = f"RLIMIT_MEMLOCK is {limit // 1024} KiB, not unlimited, without CAP_IPC_LOCK"
        return Refusal(what, why, _limits_line("memlock unlimited"))
    if _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        return Refusal(
            what, f"mlockall: {os.strerror(ctypes.get_errno())}", 'see "Keep a loop on time" in the documentation'
        )
    return None


def set_cpus(cpus: Collection[int]) -> Refusal | None:
    """Run this thread on these CPUs alone; on all of them or, if some are refused, where it ran before."""
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, cpus)
        if os.sched_getaffinity(0) == set(cpus):
            return None
        os.sched_setaffinity(0, before)  # those outside the cpuset were dropped in silence
    except OSError as error:
        if error.errno not in (EINVAL, EPERM):
            raise
    allowed = _own_status("Cpus_allowed_list")
    why = f"outside the CPU set of this process's container or service, which may use {allowed}"
    return Refusal(f"CPUs {cpus_as_text(cpus)}", why, "choose among these, or widen that set")


def _limits_line(limit: str) -> str:
    try:
        name = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a container's user that has no name
        name = "USER"
    return (
        f"put '{name} - {limit}' into /etc/security/limits.d/skinware.conf and log in again"
        ' (services, containers: see "Keep a loop on time" in the documentation)'
    )


def _has_capability(number: int) -> bool:
    return bool(int(_own_status("CapEff"), 16) >> number & 1)


def _own_status(key: str) -> str:
    for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith(f"{key}:"):
            return line.partition(":")[2].strip()
    raise LookupError(f"/proc/self/status has no {key}")


_ITEM = re.compile(r"\s*(\d{1,5})\s*(?:-\s*(\d{1,5})\s*)?", re.ASCII)
_ONLINE = Path("/sys/devices/system/cpu/online")


def cpus_from_text(text: str) -> tuple[int, ...]:
    """CPU numbers from ``1,2`` or ``0-3``, in rising order, each once.

    Raises:
        ConfigurationError: the text is no such list.
    """
    cpus: set[int] = set()
    for item in text.split(","):
        match = _ITEM.fullmatch(item)
        if match is None:
            raise ConfigurationError(f"CPUs {text!r}: give numbers from 0 with commas, as 1,2 or 0-3")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigurationError(f"CPUs {text!r}: the range {item.strip()} does not go upwards")
        cpus.update(range(first, last + 1))
    return tuple(sorted(cpus))


def cpus_as_text(cpus: Iterable[int]) -> str:
    """CPU numbers in rising order with commas."""
    return ",".join(str(cpu) for cpu in sorted(cpus))


def online_cpus() -> tuple[int, ...]:
    """All CPUs that are switched on, also those that nothing runs on unless it asks (``isolcpus``)."""
    try:
        return cpus_from_text(_ONLINE.read_text())
    except OSError:  # a container without /sys
        return tuple(range(os.cpu_count() or 1))


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

    def apply(self, *, strict: bool = False) -> tuple[Refusal, ...]:
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
        answers = [set_cpus(self.cpus) if self.cpus else None]
        if self.freeze_gc:
            gc.collect()
            gc.freeze()
        answers.append(lock_memory() if self.lock_memory else None)
        answers.append(set_policy(self.priority))
        if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:  # which has none in any case
            slack = ctypes.c_ulong(self.timer_slack_ns)  # after the policy, whose change resets it
            if _libc.prctl(_PR_SET_TIMERSLACK, slack, 0, 0, 0) != 0:
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        refusals = tuple(answer for answer in answers if answer is not None)
        if refusals and strict:
            raise RealtimeRefused("\n".join(str(refusal) for refusal in refusals))
        for refusal in refusals:
            log.warning("%s", refusal)
        return refusals
