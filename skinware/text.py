"""Write numbers, times, tables, names and the text of others as people read them. Pure functions.

All commands and views use these, so that an age or a count looks the same everywhere.
"""

from __future__ import annotations

import difflib
import re
from collections import Counter
from collections.abc import Iterable, Sequence

from skinware.status import Status, Why

NO_VALUE = "-"
NOT_FRESH = "not fresh"
"""Shown instead of ``live`` where samples arrive, but no sensor in them is fresh."""
SETTLING = "settling"
"""Shown instead of that where sensors wait for their baselines."""

_BETWEEN = "  "
_WITH_PREFIX = ("Pa", "T", "m")
_PREFIXES = ((1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "u"))
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


def nearest_name(wrong: str, right: Iterable[str]) -> str:
    """Return the end of an error message about an unknown name: the nearest name that exists, and all that do."""
    names = [*dict.fromkeys(right)]
    nearest = difflib.get_close_matches(wrong, names, n=1)
    hint = f"; did you mean {nearest[0]!r}? There" if nearest else "; there"
    return f"{hint} are: {', '.join(names) or 'none'}"


def age_text(age_ns: float | None) -> str:
    """Return a duration with its unit, in about two figures: ``40 us``, ``0.6 ms``, ``12 ms``, ``3.4 s``, ``5 min``."""
    if age_ns is None:
        return NO_VALUE
    milliseconds = max(0.0, age_ns / 1e6)
    if 0 < milliseconds < 0.0995:
        return f"{max(1, round(milliseconds * 1e3))} us"
    if milliseconds < 9.95:
        return f"{milliseconds:.1f} ms"
    if milliseconds < 999.5:
        return f"{milliseconds:.0f} ms"
    seconds = milliseconds / 1e3
    if seconds < 99.95:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 99.5 else f"{minutes / 60:.0f} h"


def age_text_ms(age_ms: float | None) -> str:
    """Return a duration that is given in milliseconds, as :func:`age_text` does."""
    return age_text(None if age_ms is None else age_ms * 1e6)


def rate_text(rate_hz: float | None) -> str:
    """Return a rate with its unit: ``0.25 Hz``, ``20.0 Hz``, ``1000 Hz``."""
    if rate_hz is None:
        return NO_VALUE
    if 0 < rate_hz < 1:
        return f"{rate_hz:.2f} Hz"
    return f"{rate_hz:.1f} Hz" if rate_hz < 999.95 else f"{rate_hz:.0f} Hz"


def count_text(count: int | None) -> str:
    """Return a count with separated thousands: ``30,848``."""
    return NO_VALUE if count is None else f"{count:,}"


def figure_text(value: float, digits: int = 4) -> str:
    """Return a measured value with this many digits, large ones whole: ``0.012``, ``150``, ``20,000``."""
    return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def prefixed(unit: str, greatest: float) -> tuple[float, str]:
    """Return by what to divide values for people, and their unit then: ``1000.0, "kPa"``.

    Pascals, teslas and metres get the prefix that fits the greatest value; other units stay as they are.
    """
    if unit not in _WITH_PREFIX or not greatest:
        return 1.0, unit
    factor, prefix = next((one for one in _PREFIXES if abs(greatest) >= one[0]), _PREFIXES[-1])
    return factor, prefix + unit


def measure_text(value: float, unit: str, digits: int = 4) -> str:
    """Return a measured value with its unit: ``101.6 kPa``, ``0.012 N``, ``150 counts``."""
    factor, unit = prefixed(unit, value)
    return f"{figure_text(value / factor, digits)} {unit}".rstrip()


def plural(count: int, what: str, several: str = "") -> str:
    """Return a count and a noun: ``1 patch``, ``4 patches``."""
    return f"{count_text(count)} {what if count == 1 else several or what + 's'}"


def words(name: str) -> str:
    """Return a name of the protocol as words: ``never_seen`` is ``never seen``."""
    return name.replace("_", " ")


def status_text(status: int) -> str:
    """Return the bits of a sensor's status as words: ``stale, suspect``; ``fresh`` without any."""
    return ", ".join(words(str(bit.name).lower()) for bit in Status if status & bit) or "fresh"


def why_text(why: int) -> str:
    """Return why a taxel of a calmed driver is in its state, in words; empty at rest."""
    return words(Why(why).name.lower()) if 0 < why < len(Why) else ""


def state_shown(state: str, fresh: int, sensors: int, settling: int = 0) -> str:
    """Return a state for people: nothing without a fresh sensor is called live."""
    without = SETTLING if settling else NOT_FRESH
    return without if state == "live" and sensors and not fresh else state


def counters_text(counters: dict[str, int], *, besides: Sequence[str] = ()) -> str:
    """Return the counters that are not 0, in the driver's own words, without those in ``besides``."""
    return _BETWEEN.join(
        f"{words(name)} {count_text(count)}" for name, count in counters.items() if count and name not in besides
    )


def table(
    titles: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1, width: int | None = None
) -> list[str]:
    """Return lines of aligned columns under their titles.

    Args:
        titles: one for each column.
        left: the first so many columns are aligned left, the others right.
        width: columns of a line; wider tables continue in a table below with the same first column.
    """
    lines = [list(titles), *(list(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(titles))]
    parts = [[0]]
    for column in range(1, len(titles)):
        used = sum(widths[c] + len(_BETWEEN) for c in parts[-1])
        if width is not None and used + widths[column] > width and len(parts[-1]) > 1:
            parts.append([0])
        parts[-1].append(column)
    return [
        _BETWEEN.join(line[c].ljust(widths[c]) if c < left else line[c].rjust(widths[c]) for c in columns).rstrip()
        for columns in parts
        for line in lines
    ]


def wrapped(line: str, width: int | None, hang: int = 4) -> list[str]:
    """Return a line, which may contain colours, broken at ``width``; continuations are indented by ``hang`` more."""

    def length(text: str) -> int:
        return len(_COLOUR.sub("", text))

    if width is None or length(line) <= width:
        return [line]
    indent = line[: len(line) - len(line.lstrip())]
    first, *others = line.lstrip().split(" ")
    lines = [indent + first]
    for word in others:
        if length(lines[-1]) + 1 + length(word) <= width:
            lines[-1] += f" {word}"
        elif word:
            lines.append(f"{indent}{' ' * hang}{word}")
    return lines


def printable(text: str, keep: str = "") -> str:
    """Return text of others with a question mark for every character that cannot be printed.

    Nothing in it moves the cursor, changes colours, or turns the reading direction: control and format characters (also
    of bidirectional text), lone surrogates and all line ends are replaced.
    """
    if text.translate(dict.fromkeys(map(ord, keep))).isprintable():
        return text
    return "".join(sign if sign.isprintable() or sign in keep else "?" for sign in text)


def distinct(names: Sequence[str], owners: Sequence[str], how: str) -> tuple[str, ...]:
    """Return the names; where several things have one name, with what they belong to: ``board 8 on can0``."""
    count = Counter(names)
    pairs = zip(names, owners, strict=True)
    return tuple(f"{name} {how} {owner}" if count[name] > 1 else name for name, owner in pairs)


def module_names(
    own_names: Sequence[str], kinds: Sequence[str], patches: Sequence[int], names_of_patches: Sequence[str]
) -> tuple[str, ...]:
    """Return the names of all modules, each after that of its patch.

    One without a name of its own has its kind and, among several of that kind in its patch, a number from 0; the only
    module of a patch is called as the patch.
    """
    pairs = zip(patches, names_in_patches(own_names, kinds, patches), strict=True)
    return tuple(joined(names_of_patches[patch], name) for patch, name in pairs)


def names_in_patches(own_names: Sequence[str], kinds: Sequence[str], patches: Sequence[int]) -> tuple[str, ...]:
    """Return what ``module_names`` adds to the names of the patches; empty where it adds nothing."""
    in_patch = Counter(patches)
    of_kind = Counter(zip(patches, kinds, strict=True))
    seen: Counter[tuple[int, str]] = Counter()
    names = []
    for own, kind, patch in zip(own_names, kinds, patches, strict=True):
        number = seen[patch, kind]
        seen[patch, kind] += 1
        if not own and in_patch[patch] > 1:
            own = kind or "module"
            own = f"{own} {number}" if of_kind[patch, kind] > 1 else own
        names.append(own)
    return tuple(names)


def joined(owner: str, name: str) -> str:
    return f"{owner}, {name}" if name else owner
