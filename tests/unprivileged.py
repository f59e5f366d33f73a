"""Runs a command without the capabilities that real-time scheduling needs, also for root, and with these limits.

``unprivileged.py RTPRIO MEMLOCK_BYTES COMMAND ...``; -1 is unlimited, and only root can raise limits.
"""

from __future__ import annotations

import ctypes
import os
import resource
import sys

PR_CAPBSET_DROP = 24
CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 1, 2
CAP_IPC_LOCK, CAP_SYS_NICE, CAP_SYS_RESOURCE = 14, 23, 24


def without_rights(*command: str, rtprio: int = 0, memlock: int = 65536) -> list[str]:
    """The arguments of a process that runs the command in this way."""
    return [sys.executable, __file__, str(rtprio), str(memlock), *command]


def without_rights_to_all_files() -> None:
    """Called in a child before it becomes another program: even root has no more rights to files there than owners."""
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            libc.prctl(PR_CAPBSET_DROP, ctypes.c_ulong(capability), 0, 0, 0)


def main() -> None:
    priority, memory = int(sys.argv[1]), int(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_RTPRIO, (priority, priority))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (memory, memory))
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (CAP_IPC_LOCK, CAP_SYS_NICE, CAP_SYS_RESOURCE):
            if libc.prctl(PR_CAPBSET_DROP, ctypes.c_ulong(capability), 0, 0, 0) != 0:
                raise OSError(ctypes.get_errno(), f"cannot give up capability {capability}")
    # a program started by root gets what is left in the bounding set
    os.execv(sys.argv[3], sys.argv[3:])


if __name__ == "__main__":
    main()
