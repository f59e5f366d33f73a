"""Commands in the bytes that emulated devices on serial lines hear."""

from __future__ import annotations

from collections.abc import Callable


def cut(heard: bytes, begin: bytes, total: Callable[[bytes], int]) -> tuple[list[bytes], bytes]:
    """Cut commands out of a stream.

    Args:
        heard: what was heard, from the end of the last command on.
        begin: first bytes of every command.
        total: tells from the bytes of a command how many it has; 0: too few to tell.

    Returns:
        The whole commands, whether or not their checksums are right; and what must be heard again with more behind it.
    """
    found: list[bytes] = []
    while (at := heard.find(begin)) >= 0:
        heard = heard[at:]
        length = total(heard)
        if not length or len(heard) < length:
            return found, heard
        found.append(heard[:length])
        heard = heard[length:]
    return found, heard[max(0, len(heard) - len(begin) + 1) :]
