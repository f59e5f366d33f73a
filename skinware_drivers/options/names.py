"""Names that people write: what is wrong with one, and whether it is a file's."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

SOURCE_SUFFIX = ".py"


def nearest_name(wrong: str, right: Iterable[str]) -> str:
    """The end of an error message about an unknown name: the nearest right one, and all there are."""
    names = sorted(right)
    nearest = difflib.get_close_matches(wrong, names, n=1)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else "."
    return f"{hint} Known: {', '.join(names) or 'none'}"


def is_file(name: str) -> bool:
    """Whether a name is that of a file, not of something that is registered."""
    return name.endswith(SOURCE_SUFFIX)
