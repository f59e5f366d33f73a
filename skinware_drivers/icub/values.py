"""Values in a robot's files: words, whole numbers (decimal or 0x), yes and no."""

from __future__ import annotations

from skinware_drivers.icub.notes import Level, Notes
from skinware_drivers.icub.xml_tree import Element

_LONGEST_NUMBER = 12


def words(text: str) -> list[str]:
    """The words of a value; quotes and the brackets of a list fall away."""
    return text.translate(str.maketrans('()"', "   ")).split()


def number(text: str) -> int:
    """A whole number as these files write it.

    Raises:
        ValueError: it is none.
    """
    if len(text) > _LONGEST_NUMBER or not text.isascii() or "_" in text:
        raise ValueError(f"{text[:20]!r} is not a whole number")
    try:
        value = int(text, 16) if text.lower().startswith("0x") else int(text, 10)
    except ValueError:
        raise ValueError(f"{text!r} is not a whole number") from None
    return value


class Reader:
    """Reads values of elements; what it cannot read is noted, and counts as not given.

    Args:
        notes: takes what was not understood.
    """

    def __init__(self, notes: Notes) -> None:
        self.notes = notes

    def numbers(self, element: Element | None) -> list[int] | None:
        """All words of an element as numbers; None if there is no element, or one is none."""
        if element is None:
            return None
        element.understood = True
        try:
            return [number(word) for word in words(element.text)]
        except ValueError as error:
            self.refuse(element, str(error))
            return None

    def number(self, element: Element | None, first: int, last: int) -> int | None:
        """The one number of an element, within limits."""
        found = self.numbers(element)
        if element is None or found is None:
            return None
        if len(found) != 1:
            self.refuse(element, f"{element.text!r} is not one number")
        elif not first <= found[0] <= last:
            self.refuse(element, f"{found[0]} is outside {first}-{last}")
        else:
            return found[0]
        return None

    def truth(self, element: Element | None) -> bool | None:
        """Yes or no as YARP reads it: the first word is ``true`` or a number that is not 0; anything else means no."""
        if element is None:
            return None
        element.understood = True
        found = words(element.text)
        try:
            value = found[:1] == ["true"] or bool(number("".join(found[:1])))
            clear = len(found) == 1
        except ValueError:
            value, clear = False, found == ["false"]
        if not clear:
            text = f"{element.text!r} is neither true nor false; taken to be {str(value).lower()}, as on the robot"
            self.note("odd", element, text)
        return value

    def refuse(self, element: Element, why: str) -> None:
        """Note that a value was not understood."""
        self.note("unknown", element, f"{why}; left out")

    def note(self, level: Level, element: Element, text: str) -> None:
        """Note something about an element."""
        self.notes.add(level, element.file, text, line=element.line, element=element.label)
