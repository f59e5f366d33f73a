"""Answers to commands: the result, or an error that says what is wrong."""

from __future__ import annotations

import pytest

from skinware.errors import BusError
from skinware_drivers.serial import Answers, Refused

ANSWERS = Answers("hand", {3: "it is busy", 0x103: "it is hot"}, offset=1, dtype="<u2")


@pytest.mark.parametrize(("payload", "result"), [(b"x\0\0", b""), (b"x\0\0abc", b"abc")])
def test_what_is_behind_the_status(payload: bytes, result: bytes) -> None:
    assert ANSWERS.result(7, payload, size=len(result)) == result


@pytest.mark.parametrize(
    ("payload", "status", "why"),
    [(b"x\x03\0", 3, "it is busy"), (b"x\x03\x01", 0x103, "it is hot"), (b"x\0\x01", 256, "look")],
)
def test_a_refusal(payload: bytes, status: int, why: str) -> None:
    with pytest.raises(Refused, match=f"the hand refuses command 0x07 with status {status}: {why}") as raised:
        ANSWERS.result(7, payload, size=5)
    assert raised.value.status == status


@pytest.mark.parametrize(
    ("payload", "what"),
    [
        (b"", "no status"),
        (b"x\0", "no status"),
        (b"x\0\0", "0 bytes instead of 2"),
        (b"x\0\0a", "1 bytes instead of 2"),
    ],
)
def test_an_answer_that_is_too_short(payload: bytes, what: str) -> None:
    with pytest.raises(BusError, match=f"the hand's answer to command 0x07 has {what}") as raised:
        ANSWERS.result(7, payload, size=2)
    assert not isinstance(raised.value, Refused)
