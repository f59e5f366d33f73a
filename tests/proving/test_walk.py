"""The walk over an emulated hand, which a test presses as asked; planted faults are found."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skinware.errors import BusError
from skinware_drivers.proving.proof import Check, Verdict
from tests.proving.rig import COLUMNS, NAMES, ROWS, EmulatedHand, N, PressingPerson, failed, proven, straight

INDEX, MIDDLE = (f"hand, {name}" for name in NAMES)


@pytest.mark.thorough
def test_a_driver_in_order_is_proven() -> None:
    person = PressingPerson()
    proof = proven(person, straight())
    assert failed(proof) == {}
    passed = {(check.what, check.where) for check in proof.checks if check.verdict == "passed"}
    for name in (INDEX, MIDDLE):
        assert {(what, name) for what in ("right module", "sign", "order of taxels", "taxel answers")} <= passed
    wanted = ["press", "let go", "stroke down", "stroke across"]
    assert [(step.wanted, step.module) for step in person.asked] == [
        ("rest", ""),
        *((step, name) for name in (INDEX, MIDDLE) for step in wanted),
    ]


@pytest.mark.thorough
def test_planted_faults_are_found() -> None:
    """Mirrored rows and a dead taxel of the index tip; two exchanged taxels of the middle tip."""
    wiring = straight()
    wiring[:N] = np.arange(N).reshape(ROWS, COLUMNS)[::-1].ravel()
    wiring[[N + 1, N + 16]] = wiring[[N + 16, N + 1]]
    proof = proven(PressingPerson(), wiring, dead=[5])
    assert failed(proof) == {
        ("order of taxels", INDEX): "rows are mirrored: the last comes first",
        ("taxel answers", f"{INDEX}, taxel 5"): "always 7",
        ("order of taxels", MIDDLE): "taxels 1 and 16 are exchanged",
    }
    assert not proof.is_proven


@pytest.mark.thorough
def test_another_module_that_answers_is_named_and_one_that_is_not_wanted_is_skipped() -> None:
    wiring = np.roll(straight(), N)
    proof = proven(PressingPerson(skipped=[MIDDLE], ignored=["stroke down"]), wiring, patience_s=3.0)
    wrong = failed(proof)
    assert wrong["order of taxels", INDEX] == "no stroke was felt within 3 s"
    (check,) = [
        one for one in proof.checks if (one.what, one.where, one.verdict) == ("right module", MIDDLE, "skipped")
    ]
    assert check.seen == "not wanted"
    pressed = next(one for one in proof.checks if (one.what, one.where) == ("right module", INDEX))
    assert pressed.verdict == "failed"
    assert MIDDLE in pressed.seen


def test_nobody_presses_anything() -> None:
    proof = proven(PressingPerson(ignored=["press"]), straight(), patience_s=0.3, only=["index"])
    assert failed(proof) == {("right module", INDEX): "nothing was felt within 0.3 s"}
    assert not proof.is_proven


def tared(on_tare: Callable[[EmulatedHand], None], **more: Any) -> Check:
    """Return the check of taring, with a person who presses nothing."""
    manner: dict[str, Any] = {"patience_s": 0.1, "only": ["index"], "with_tare": True} | more
    skipped = manner.pop("skipped", [])
    person = PressingPerson(ignored=["press"], skipped=skipped)
    (check,) = (one for one in proven(person, straight(), (), on_tare, **manner).checks if one.what == "tare")
    return check


@pytest.mark.thorough
def test_taring_is_tried_if_it_is_wanted() -> None:
    def tare(hand: EmulatedHand) -> None:
        hand.offset = 0

    def refuse(_hand: EmulatedHand) -> None:
        raise BusError("it is not at rest")

    done = tared(tare)
    assert done.verdict is Verdict.PASSED
    assert done.seen in [f"at most {noise} counts is left" for noise in (1, 2)]
    in_vain = tared(lambda _hand: None)
    assert in_vain.verdict is Verdict.FAILED
    assert in_vain.seen in [f"at most {10 + noise} counts is left" for noise in (1, 2)]
    refused = tared(refuse)
    assert refused.verdict is Verdict.FAILED
    assert "it is not at rest" in refused.seen


@pytest.mark.thorough
def test_taring_changes_a_device_so_nobody_has_to_want_it() -> None:
    tares: list[EmulatedHand] = []
    unasked = tared(tares.append, with_tare=False)
    assert (unasked.verdict, unasked.seen) == (Verdict.UNKNOWN, "not wanted (--tare)")
    assert tares == []
    skipped = tared(tares.append, skipped=[""])  # the rest at the beginning cannot be skipped
    assert skipped.verdict is Verdict.SKIPPED
