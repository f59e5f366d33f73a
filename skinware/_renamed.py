"""Names that were changed: the old ones go on for one release."""

from __future__ import annotations

import warnings


def renamed(old: str, new: str) -> None:
    warnings.warn(
        f"{old} is called {new} now; the old name ends with the next release", DeprecationWarning, stacklevel=3
    )
