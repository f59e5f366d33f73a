"""Which account a connection over loopback comes from, as the kernel tells."""

from __future__ import annotations

import ipaddress
import sys
from pathlib import Path

_TABLES = {4: Path("/proc/net/tcp"), 6: Path("/proc/net/tcp6")}
_LOCAL, _REMOTE, _UID = 1, 2, 7
"""Columns of the tables."""
_WORD = 4


def account_of(peer: tuple[str, int], here: tuple[str, int]) -> int | None:
    """The user id of the other end's owner; None where the kernel does not tell.

    Args:
        peer: address and port of the other end, on this machine.
        here: those of this end.
    """
    local, remote = _in_table(peer), _in_table(here)
    try:
        lines = _TABLES[ipaddress.ip_address(peer[0]).version].read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        columns = line.split()
        if columns[_LOCAL] == local and columns[_REMOTE] == remote:
            return int(columns[_UID])
    return None


def _in_table(end: tuple[str, int]) -> str:
    """As the tables have it: words of the address in the order of the machine, and the port."""
    address = ipaddress.ip_address(end[0]).packed
    words = [int.from_bytes(address[at : at + _WORD], sys.byteorder) for at in range(0, len(address), _WORD)]
    return "".join(f"{word:08X}" for word in words) + f":{end[1]:04X}"
