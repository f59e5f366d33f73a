"""A descriptor that becomes readable at a moment of CLOCK_MONOTONIC (Linux timerfd, by ctypes).

Python has ``os.timerfd_create`` only since 3.13.
"""

from __future__ import annotations

import ctypes
import os
from typing import Protocol

from skinware.errors import PlatformError

_CLOCK_MONOTONIC = 1
_TFD_NONBLOCK, _TFD_CLOEXEC = os.O_NONBLOCK, os.O_CLOEXEC
_TFD_TIMER_ABSTIME = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("it_interval", _Timespec), ("it_value", _Timespec))


class Timer(Protocol):
    """A descriptor that becomes readable at a moment."""

    def fileno(self) -> int: ...

    def wake_at(self, time_ns: int | None) -> None: ...

    def close(self) -> None: ...


class MonotonicTimer:
    """An open timer that does not run.

    Raises:
        PlatformError: this system has no timerfd.
        OSError: no descriptor was left.
    """

    def __init__(self) -> None:
        # PyDLL: the calls never block, so they need not let go of the interpreter lock and wait for it again
        libc = ctypes.PyDLL(None, use_errno=True)
        try:
            create, self._settime = libc.timerfd_create, libc.timerfd_settime
        except AttributeError:
            raise PlatformError("this system has no timerfd, which emulated buses need: use Linux") from None
        self._fd: int = create(_CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), f"timerfd_create: {os.strerror(ctypes.get_errno())}")
        self._spec = _Itimerspec()

    def fileno(self) -> int:
        """The descriptor; -1 once closed."""
        return self._fd

    def wake_at(self, time_ns: int | None) -> None:
        """Make the descriptor readable at ``time_ns`` (at once if that is past), and not readable before.

        Args:
            time_ns: CLOCK_MONOTONIC ns; None for never.

        Raises:
            OSError: the timer is closed.
        """
        value = self._spec.it_value
        value.tv_sec, value.tv_nsec = (0, 0) if time_ns is None else divmod(max(time_ns, 1), 1_000_000_000)
        if self._settime(self._fd, _TFD_TIMER_ABSTIME, ctypes.byref(self._spec), None) < 0:
            raise OSError(ctypes.get_errno(), f"timerfd_settime: {os.strerror(ctypes.get_errno())}")

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
