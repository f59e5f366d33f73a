"""The numbers of the rule, as ``skinware/native/baseline.h`` has them."""

from __future__ import annotations

import re
from pathlib import Path

from skinware import native
from skinware.tactile import baseline

_TEXT = Path(native.__file__).with_name("baseline.h").read_text()
_NUMBERS = {
    name: float(number) for name, number in re.findall(r"^#define (\w+) ([\d.e+-]+?)f? +/\*", _TEXT, re.MULTILINE)
}
_NUMBERS["GAIN_SPREAD"] = _NUMBERS["GAIN_SPREAD2"] ** 0.5
_NUMBERS["ENOUGH_BLOCKS"] /= _NUMBERS["BLOCKS"]
_NUMBERS["FORGET_AFTER_S"] = baseline.FORGET_AFTER_S


def __getattr__(name: str) -> float:
    if name not in _NUMBERS:
        raise AttributeError(f"the rule has no number {name}")
    return _NUMBERS[name]
