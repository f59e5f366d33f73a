"""How the kernel treats a process or thread, as the kernel tells it."""

from __future__ import annotations

import os
import resource
from pathlib import Path


def policy(thread: int) -> tuple[int, int]:
    """(policy, priority) of a process' first thread, or of a thread by its id."""
    return os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority


def threads_under(policy_number: int, process: int) -> int:
    """How many threads of a process are under a policy."""
    threads = [int(name) for name in os.listdir(f"/proc/{process}/task")]
    return sum(os.sched_getscheduler(thread) == policy_number for thread in threads)


def locked_kib(process: int) -> int:
    """VmLck: the size of all maps of a process that are locked."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("VmLck:"):
            return int(line.split()[1])
    raise AssertionError("the kernel does not say VmLck")


def timer_slack_ns(process: int) -> int:
    """Timer slack of a process' first thread; for processes of others this needs CAP_SYS_NICE."""
    return int(Path(f"/proc/{process}/timerslack_ns").read_text())


def may_have_fifo(priority: int) -> bool:
    """Whether this process could get SCHED_FIFO and unlimited locked memory."""
    status = Path("/proc/self/status").read_text()
    capabilities = next(int(line.split()[1], 16) for line in status.splitlines() if line.startswith("CapEff:"))
    nice = capabilities >> 23 & 1 or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] >= priority
    lock = capabilities >> 14 & 1 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    return bool(nice and lock)
