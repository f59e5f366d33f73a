"""Options from texts, and the errors that tell what to write instead."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import pytest

import skinware_drivers
from skinware.errors import ConfigurationError
from skinware_drivers.options import describe_options, option_text, options_from_strings
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: Annotated[str, msgspec.Meta(description="what it is called")]
    boards: Annotated[tuple[int, ...], msgspec.Meta(description="addresses")] = (7, 8)
    words: list[str] = []
    loss: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0
    fast: bool = False
    count: int | None = None
    kind: Literal["a", "b"] = "a"
    kinds: tuple[Literal["a", "b"], ...] = ()
    most: Annotated[int, msgspec.Meta(ge=1)] | None = None


def make(**texts: str) -> Options:
    return options_from_strings(Options, {"name": "x", **texts})


@pytest.mark.parametrize(
    ("text", "boards"),
    [
        ("7", (7,)),
        ("7,8,9,10", (7, 8, 9, 10)),
        ("7-10", (7, 8, 9, 10)),
        (" 1, 3 - 5 ,9", (1, 3, 4, 5, 9)),
        ("14,7", (14, 7)),
        ("3-3", (3,)),
        ("", ()),
        ("7,,8,", (7, 8)),
        ("-3", (-3,)),
        ("0x710,0xfF, 3", (0x710, 0xFF, 3)),
    ],
)
def test_lists_of_numbers(text: str, boards: tuple[int, ...]) -> None:
    assert make(boards=text).boards == boards


@pytest.mark.parametrize(
    ("text", "yes"),
    [("", True), ("yes", True), ("ON", True), ("true", True), ("1", True), ("no", False), ("off", False),
     ("False", False), ("0", False)],
)  # fmt: skip
def test_yes_and_no(text: str, yes: bool) -> None:
    assert make(fast=text).fast is yes


def test_other_types() -> None:
    options = make(words="a/1, b/2", loss="1e-2", count="12", kind="b")
    assert (options.words, options.loss, options.count, options.kind) == (["a/1", "b/2"], 0.01, 12, "b")


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ({"bords": "7"}, r"unknown option 'bords'; did you mean 'boards'\? There are: boards, count, fast"),
        ({"zzz": "7"}, r"unknown option 'zzz'; there are: boards"),
        ({"boards": "7,x"}, r"option boards=7,x: give a whole number \(number 2 of the list\)"),
        ({"boards": "9-7"}, r"option boards=9-7: the range 9-7 does not go upwards"),
        ({"boards": "0-99999999"}, "too long"),
        ({"loss": "1.5"}, r"option loss=1.5: give a number <= 1"),
        ({"loss": "much"}, r"option loss=much: give a number$"),
        ({"fast": "maybe"}, r"option fast=maybe: give yes or no$"),
        ({"kind": "c"}, r"option kind=c: give one of a, b$"),
        ({"kinds": "a,d"}, r"option kinds=a,d: give one of a, b \(number 2 of the list\)$"),
        ({"most": "many"}, r"option most=many: give a whole number$"),
        ({"count": "1.5"}, r"option count=1.5: give a whole number"),
    ],
)
def test_errors_say_what_is_wrong(texts: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make(**texts)


def test_a_required_option_must_be_given() -> None:
    with pytest.raises(ConfigurationError, match="option 'name' must be given"):
        options_from_strings(Options, {})


def test_descriptions() -> None:
    described = {option.name: option for option in describe_options(Options)}
    assert described["name"].required
    assert (described["boards"].kind, described["boards"].default) == ("INTEGER,...", "7,8")
    assert described["boards"].description == "addresses"
    assert [described[name].kind for name in ("words", "loss", "fast", "count", "kind")] == [
        "TEXT,...", "NUMBER", "yes/no", "INTEGER", "a|b"]  # fmt: skip
    assert [described[name].default for name in ("words", "loss", "fast", "count")] == ["", "0.0", "no", ""]


def test_every_default_of_the_emulator_can_be_written_as_text() -> None:
    assert EmulatedRoboskin.Options is EmulatedRoboskinOptions
    texts = {option.name: option.default for option in describe_options(EmulatedRoboskinOptions) if option.default}
    assert options_from_strings(EmulatedRoboskinOptions, texts) == EmulatedRoboskinOptions()
    assert all(option.description for option in describe_options(EmulatedRoboskinOptions))


class Lossy(skinware_drivers.Options, frozen=True):
    loss: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0


def test_constructors_check_limits() -> None:
    assert Lossy(loss=1.0).loss == 1.0
    with pytest.raises(ConfigurationError, match=r"option loss=2\.0: give a number <= 1"):
        Lossy(loss=2.0)


def test_option_text() -> None:
    values: list[object] = [(7, 8), True, False, 0.5, None, []]
    assert [option_text(value) for value in values] == ["7,8", "yes", "no", "0.5", "", ""]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"boards": ()}, "at least one board"),
        ({"boards": (0,)}, "address 0 is outside 1-14"),
        ({"boards": (7, 15)}, "address 15 is outside 1-14"),
        ({"boards": (7, 7)}, "twice"),
        ({"boards": (7,), "mtb3": (8,)}, "option mtb3: there is no board 8; boards=7"),
        ({"boards": (7,), "dead": (8,)}, "option dead: there is no board 8"),
        ({"boards": (7,), "restart": (8,)}, "option restart: there is no board 8"),
        ({"unplugged": ("7",)}, "option unplugged: '7' is not of the form BOARD/TRIANGLE"),
        ({"unplugged": ("7/16",)}, "triangle 16 in '7/16' is outside 0-15"),
        ({"no_ack": ("11/3",)}, "option no_ack: there is no board 11"),
        ({"not_connected": ("7/-1",)}, "not of the form"),
        ({"out_of_range": ("7/3",)}, "BOARD/TRIANGLE/TAXEL"),
        ({"out_of_range": ("7/3/12",)}, "taxel 12 in '7/3/12' is outside 0-11"),
        ({"lose": 1.5}, "option lose=1.5"),
        ({"lose": "x"}, "option lose=x"),
        ({"pattern": "tickle"}, "option pattern=tickle"),
        ({"jitter_us": -1}, "option jitter_us=-1"),
    ],
)
def test_bad_options_of_the_emulator(options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        EmulatedRoboskinOptions(**options)  # type: ignore[arg-type]


def test_hexadecimal_numbers() -> None:
    assert make(count="0x1F").count == 0x1F
    with pytest.raises(ConfigurationError, match="option count=0x1G"):
        make(count="0x1G")
