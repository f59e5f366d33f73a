"""Ask the kernel for what a loop needs. A lack of rights is no error here: it comes back in words."""

from __future__ import annotations

import ctypes
import os
import pwd
import re
import resource
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from errno import EINVAL, EPERM
from pathlib import Path

from skinware.errors import ConfigurationError

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


def is_fifo() -> bool:
    """Return whether this thread runs under SCHED_FIFO."""
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO


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
    why = f"outside the CPU set of this process's container or service, which may use {_allowed_cpus()}"
    return Refusal(f"CPUs {cpus_as_text(cpus)}", why, "choose among these, or widen that set")


def set_timer_slack(slack_ns: int) -> None:
    """Return how late timers of this thread may be; a SCHED_FIFO thread has none, whatever is set."""
    if _libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns), 0, 0, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


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


def _allowed_cpus() -> str:
    return _own_status("Cpus_allowed_list")


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
