from __future__ import annotations

import click
import pytest

from skinware.text import age_text, count_text, measure_text, plural, prefixed, rate_text, table, wrapped


@pytest.mark.parametrize(
    ("age_ns", "text"),
    [
        (None, "-"),
        (-5, "0.0 ms"),
        (600_000, "0.6 ms"),
        (9_949_999, "9.9 ms"),
        (12_400_000, "12 ms"),
        (999_400_000, "999 ms"),
        (999_600_000, "1.0 s"),
        (99_900_000_000, "99.9 s"),
        (100_000_000_000, "2 min"),
        (99 * 60 * 10**9, "99 min"),
        (7 * 3600 * 10**9, "7 h"),
    ],
)
def test_ages_have_units(age_ns: int | None, text: str) -> None:
    assert age_text(age_ns) == text


@pytest.mark.parametrize(
    ("rate_hz", "text"), [(None, "-"), (0.0, "0.0 Hz"), (0.25, "0.25 Hz"), (20.04, "20.0 Hz"), (1000.2, "1000 Hz")]
)
def test_rates_have_units(rate_hz: float | None, text: str) -> None:
    assert rate_text(rate_hz) == text


def test_values_have_the_unit_in_which_they_are_read() -> None:
    assert measure_text(101_600, "Pa") == "101.6 kPa"
    assert measure_text(-2.5e-5, "T") == "-25 uT"
    assert measure_text(0.0015, "m", 2) == "1.5 mm"
    assert measure_text(0.002, "N") == "0.002 N"
    assert measure_text(3, "") == "3"
    assert prefixed("Pa", 0) == (1, "Pa")


def test_counts_and_plurals() -> None:
    assert (count_text(30848), count_text(None)) == ("30,848", "-")
    assert (plural(1, "patch", "patches"), plural(4, "patch", "patches")) == ("1 patch", "4 patches")
    assert plural(0, "reader") == "0 readers"


def test_a_table_that_is_too_wide_goes_on_below() -> None:
    lines = table(("name", "how", "count"), [("a", "x", "1"), ("longer", "yy", "12345")], left=2, width=13)
    assert lines == ["name    how", "a       x", "longer  yy", "name    count", "a           1", "longer  12345"]
    assert table(("name", "how"), [("a", "x")], width=3) == ["name  how", "a       x"]  # there is no narrower


def test_a_line_that_is_too_wide_is_broken() -> None:
    line = "  " + click.style("driver", bold=True) + " one two three"
    assert [click.unstyle(part) for part in wrapped(line, 14)] == ["  driver one", "      two", "      three"]
    assert wrapped(line, None) == wrapped(line, 80) == [line]


def test_tables_are_aligned() -> None:
    assert table(("name", "how", "count"), [("a", "x", "1"), ("longer", "yy", "12345")], left=2) == [
        "name    how  count",
        "a       x        1",
        "longer  yy   12345",
    ]
