"""Memory order between processes: what makes a plain store of the sequence enough, or not.

x86-64 keeps the order of loads and of stores (Intel SDM vol. 3, 9.2.3), so aligned 8-byte accesses suffice. On
other processors the two fences of the slot protocol come from our own compiled code, or from libatomic.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable

from skinware import native
from skinware.errors import PlatformError

_SEQUENTIALLY_CONSISTENT = 5  # memory_order_seq_cst of <stdatomic.h>
_TOTAL_STORE_ORDER = ("x86_64", "amd64", "AMD64")


def _nothing() -> None:
    pass


def fence_for(
    machine: str, compiled: native.Library | None = None, library: str = "libatomic.so.1"
) -> Callable[[], None]:
    """The fence that a processor needs between a slot's sequence and its data.

    Args:
        machine: what ``platform.machine`` calls the processor.
        compiled: our own code, None where Python does its work.
        library: where else there is a fence.

    Raises:
        PlatformError: the processor needs fences, nothing is compiled, and there is no libatomic.
    """
    if machine in _TOTAL_STORE_ORDER:
        return _nothing
    if compiled is not None:
        own: Callable[[], None] = compiled.quick.skinware_native_fence
        return own
    try:
        thread_fence = ctypes.CDLL(library).atomic_thread_fence
    except (OSError, AttributeError):
        raise PlatformError(
            f"this processor ({machine}) needs memory fences, and {library} is not installed; "
            "install it (Debian and Ubuntu: apt install libatomic1)"
        ) from None
    thread_fence.argtypes = [ctypes.c_int]
    thread_fence.restype = None
    return lambda: thread_fence(_SEQUENTIALLY_CONSISTENT)


fence = fence_for(platform.machine(), native.core())
"""Orders everything before it against everything after it, for all processes that map the memory."""
