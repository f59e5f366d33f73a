"""Answers to commands that begin with a status: 0, or a number that says why it was not done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from skinware.errors import BusError


class Refused(BusError):
    """A device refused a command.

    Attributes:
        status: the number with which it answered.
    """

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class Answers:
    """How devices of one kind answer commands.

    Attributes:
        device: name of the devices in messages.
        reasons: what a status other than 0 means, in words.
        offset: first byte of the status.
        dtype: of the status: unsigned, with byte order.
    """

    device: str
    reasons: Mapping[int, str] = field(hash=False)
    offset: int = 0
    dtype: str = "u1"

    def result(self, command: int, payload: bytes, size: int = 0) -> bytes:
        """What an answer says behind its status.

        Args:
            command: what was answered, for messages.
            payload: of the answer.
            size: bytes that the result has at least.

        Raises:
            Refused: the device does not do it.
            BusError: the answer is too short.
        """
        start = self.offset + np.dtype(self.dtype).itemsize
        if len(payload) < start:
            raise BusError(f"the {self.device}'s answer to command {command:#04x} has no status")
        status = int(np.frombuffer(payload, self.dtype, 1, self.offset)[0])
        if status:
            why = self.reasons.get(status, "look into the maker's manual")
            raise Refused(f"the {self.device} refuses command {command:#04x} with status {status}: {why}", status)
        result = payload[start:]
        if len(result) < size:
            raise BusError(
                f"the {self.device}'s answer to command {command:#04x} has {len(result)} bytes instead of {size}"
            )
        return result
