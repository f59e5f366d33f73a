"""Sleep on words of shared memory, and order what is written there."""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import time
from collections.abc import Callable, Sequence
from errno import EAGAIN, EINTR, ENOSYS, ETIMEDOUT

import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.errors import PlatformError
from skinware.realtime import NS_PER_S, now_ns

_TOTAL_STORE_ORDER = ("x86_64", "amd64", "AMD64")


fence: Callable[[], None] = (
    (lambda: None) if platform.machine() in _TOTAL_STORE_ORDER else native.core().quick.skinware_native_fence
)
"""Orders everything before it against everything after it, for all processes that map the memory."""


_SYS_FUTEX = {"x86_64": 202, "aarch64": 98, "riscv64": 98}
_SYS_FUTEX_WAITV = 449  # the same number on every architecture, Linux 5.16
_FUTEX_WAIT = 0
_FUTEX_WAKE = 1
_FUTEX_32 = 2
_EVERYBODY = 2**31 - 1
_CLOCK_MONOTONIC = 1
MAX_WORDS = 128
"""The most words one ``wait_any`` can take (FUTEX_WAITV_MAX)."""
_POLL_NS = 1_000_000
"""Where the kernel cannot wait for several words."""

_syscall = ctypes.CDLL(None, use_errno=True).syscall
_sleep = ctypes.CDLL(None).syscall  # without the GIL, and without the errno, which costs as much as the call
_poke = ctypes.PyDLL(None).syscall  # with the GIL: it never blocks
for _function in (_syscall, _sleep, _poke):
    _function.restype = ctypes.c_long


class Timespec(ctypes.Structure):
    _fields_ = [("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long)]


if platform.machine() not in _SYS_FUTEX:
    raise PlatformError(f"the futex system call number of {platform.machine()} is not known here")
_sys_futex = ctypes.c_long(_SYS_FUTEX[platform.machine()])
_wake = ctypes.c_int(_FUTEX_WAKE)
_wait = ctypes.c_int(_FUTEX_WAIT)
_all_waiters = ctypes.c_int(_EVERYBODY)


class Word:
    """A futex word in an array, which it keeps mapped. Not for several threads at once.

    After a sleep the processor's caches are cold, and each object that need not be touched then is time saved:
    the arguments of the system calls are made here, and what could go wrong with them is found here (OSError).

    Args:
        memory: (n,) uint8.
        offset: of the word in it, bytes.
    """

    def __init__(self, memory: npt.NDArray[np.uint8], offset: int) -> None:
        self._memory = memory
        self.address: int = memory.ctypes.data + offset
        self._address = ctypes.c_void_p(self.address)
        self._expected = ctypes.c_uint32()
        self._timeout = Timespec()
        self._timeout_at = ctypes.byref(self._timeout)
        self._timeout_ns = 0
        if _syscall(_sys_futex, self._address, _wait, self._expected, self._timeout_at) < 0:
            number = ctypes.get_errno()
            if number not in (EAGAIN, EINTR, ETIMEDOUT):
                raise OSError(number, os.strerror(number))

    @property
    def value(self) -> int:
        return ctypes.c_uint32.from_address(self.address).value

    def wake_all(self) -> None:
        """Wake everybody who waits on the word: one system call."""
        _poke(_sys_futex, self._address, _wake, _all_waiters)

    def wait(self, expected: int, timeout_ns: int) -> None:
        """Sleep until the word is woken, differs from ``expected``, or the time is up; may return early.

        The caller looks at the memory again in any case, so no reason is returned. The GIL is free
        meanwhile, and a signal ends the wait, so that its Python handler runs.
        """
        self._expected.value = expected
        if timeout_ns != self._timeout_ns:
            self._timeout.seconds, self._timeout.nanoseconds = divmod(timeout_ns, NS_PER_S)
            self._timeout_ns = timeout_ns
        _sleep(_sys_futex, self._address, _wait, self._expected, self._timeout_at)


def wait_any(words: Sequence[tuple[Word, int]], deadline_ns: int) -> bool:
    """Sleep until one of several words is woken or differs from its expected value, or the deadline is there.

    Args:
        words: with what is expected in each, 1 to :data:`MAX_WORDS`.
        deadline_ns: CLOCK_MONOTONIC ns.

    Returns:
        False if the kernel is older than 5.16 and cannot do it; the caller then polls.
    """
    entry = struct.Struct("QQII")  # struct futex_waitv: val, uaddr, flags, reserved
    table = ctypes.create_string_buffer(
        b"".join(entry.pack(value, word.address, _FUTEX_32, 0) for word, value in words)
    )
    deadline = Timespec(deadline_ns // NS_PER_S, deadline_ns % NS_PER_S)
    result = _syscall(
        ctypes.c_long(_SYS_FUTEX_WAITV),
        table,
        ctypes.c_uint(len(words)),
        ctypes.c_uint(0),
        ctypes.byref(deadline),
        ctypes.c_int(_CLOCK_MONOTONIC),
    )
    if result < 0:
        number = ctypes.get_errno()
        if number == ENOSYS:
            return False
        if number not in (EAGAIN, EINTR, ETIMEDOUT):
            raise OSError(number, os.strerror(number))
    return True


def sleep_on(words: Sequence[tuple[Word, int]], until_ns: int) -> None:
    """Sleep until any of some words, none or any number, is not as expected, or until a time; may return early."""
    remaining_ns = max(0, until_ns - now_ns())
    if len(words) == 1:
        word, expected = words[0]
        word.wait(expected, remaining_ns)
    elif not words:
        time.sleep(remaining_ns / NS_PER_S)
    elif not wait_any(words[:MAX_WORDS], until_ns):
        time.sleep(min(remaining_ns, _POLL_NS) / NS_PER_S)
