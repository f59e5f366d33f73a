"""Text of others, for a terminal: nothing in it moves the cursor, changes colours, or turns the reading direction."""

from __future__ import annotations


def printable(text: str, keep: str = "") -> str:
    """A text in which every character that cannot be printed is a question mark.

    Those are control and format characters (also of bidirectional text), lone surrogates, and all ends of lines.

    Args:
        text: any.
        keep: characters that stay, whatever they are.
    """
    if text.translate(dict.fromkeys(map(ord, keep))).isprintable():
        return text
    return "".join(sign if sign.isprintable() or sign in keep else "?" for sign in text)
