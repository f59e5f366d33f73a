"""Explain what skin-top shows, and its keys, over its screen."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

from skinware.cli._painting import MARK_CHARACTERS, MARK_NAMES
from skinware.cli._top_rows import COLUMNS

MEANINGS = dict(
    zip(
        COLUMNS,
        (
            "a driver, its buses, and the patches on each",
            "live, or what is wrong; a driver that hangs is silent",
            "snapshots a second of a driver, updates of a patch",
            "time since the newest value was measured",
            "sensors with a good and new value, of all",
            "frames thrown away before the driver read them",
            "frames of no update that the driver could complete",
            "other counts of the row; all are below the picture",
        ),
        strict=True,
    )
)
"""The meaning of each column of the list."""

REASONS = {
    "held": "touched; the baseline is predicted, not measured",
    "relearning": "the baseline is not known yet, or less well than the noise",
    "covered": "below its baseline: covered, or touched when that was measured",
    "doubted": "falls and returns untouched: its polarity may be wrong",
    "saturated": "at the end of its range: it may bear more than it shows",
    "no resolution": "too few levels to show how strong a touch is",
}
"""The meaning of each reason of a calmed driver, as :func:`skinware.text.why_text` writes them."""

KEYS = {
    "up, down": "choose a row; the picture shows its sensors",
    "o": "order: the worst states first, or as drivers name their parts",
    "t": "next sensor type",
    "s": "colours: change since the baseline, range, raw counts",
    "b": "take the present values as the baseline of the picture",
    "r": "next region, if regions were given",
    "PgUp, PgDn": "scroll the picture",
    "mouse": "point at a sensor: name, value and status",
    "q": "quit",
}


def text() -> str:
    """Return the explanations, in lines of at most 76 columns."""
    marks = {MARK_CHARACTERS[mark]: name for mark, name in MARK_NAMES.items()}
    parts = {"Columns": MEANINGS, "Marks over sensors": marks, "Reasons, beside skin-calm": REASONS, "Keys": KEYS}
    lines = []
    for title, meanings in parts.items():
        lines += ["", title, *(f"  {name:<18} {meaning}" for name, meaning in meanings.items())]
    return "\n".join(lines[1:])


class Help(ModalScreen[None]):
    """The explanations; any of its keys closes them."""

    CSS = """
    Help { align: center middle; }
    Help > VerticalScroll {
        width: 82; max-width: 100%; height: auto; max-height: 100%; border: round #27548a; padding: 0 1;
    }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,question_mark,q", "dismiss", "Close")]

    def compose(self) -> ComposeResult:
        with VerticalScroll():
            yield Static(text(), markup=False)
