"""Draw the list of skin-top: drivers, buses and patches, one of them chosen."""

from __future__ import annotations

from rich.segment import Segment
from rich.style import Style
from textual import events
from textual.geometry import Region
from textual.message import Message
from textual.strip import Strip

from skinware.cli._painting import TextLines
from skinware.cli._top_rows import COLUMNS, DRIVER, ListRow, RowKey
from skinware.state import GOOD
from skinware.text import printable

_WIDTHS = (19, 10, 8, 6, 11, 7, 7, 60)
_LEFT_COLUMNS = (0, 1, 7)
_FRESH = 4
_MOST_WANTED = (1, 4, 2, 3, 5, 6, 7)
"""Columns beside the name, in the order in which they get room."""
_LEAST_NAME, _LEAST_OTHERS, _GAP = 16, 20, 2
_FINE, _PARTLY = "#6cc070", "#e6c440"
_COLOURS = (_PARTLY, "#5fb3d9", "#e68a3c", "#e8453c")
"""Colours of states, by how bad they are; a good one is ``_FINE`` where all sensors are fresh."""


def room_for(width: int) -> dict[int, int]:
    """Return the columns that a line has room for, in their order, each with its width."""
    found, left = {0: _WIDTHS[0]}, width - _WIDTHS[0]
    if width < sum(_WIDTHS[:5]) + 4 * _GAP:
        found, left = {0: _LEAST_NAME}, width - _LEAST_NAME
    for column in _MOST_WANTED:
        wanted = _WIDTHS[column]
        if left < _GAP + (_LEAST_OTHERS if column == len(_WIDTHS) - 1 else wanted):
            break
        found[column] = min(wanted, left - _GAP)
        left -= _GAP + found[column]
    return dict(sorted(found.items()))


class DriverList(TextLines):
    """Rows under their titles. The row that a person chose stays chosen, wherever it is, and when it comes back."""

    class RowChosen(Message):
        """Another row is chosen."""

    def __init__(self, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self.rows: list[ListRow] = []
        self.cursor = 0
        self._wanted: RowKey | None = None

    @property
    def chosen(self) -> ListRow | None:
        return self.rows[self.cursor] if self.cursor < len(self.rows) else None

    def show(self, rows: list[ListRow]) -> None:
        before, self.rows = self.rows, rows
        keys = [row.key for row in rows]
        at = keys.index(self._wanted) if self._wanted in keys else 0
        if self._wanted is None and rows:
            self._wanted = keys[0]
        if len(rows) != len(before):
            self.changed_all(0, len(rows) + 1)
        else:
            self.changed(1 + n for n, (row, old) in enumerate(zip(rows, before, strict=True)) if row != old)
        self._go(at)

    def choose(self, at: int) -> None:
        if 0 <= at < len(self.rows):
            self._wanted = self.rows[at].key
            self._go(at)

    def _go(self, at: int) -> None:
        before, self.cursor = self.cursor, at
        if at == before:
            return
        self.changed((1 + before, 1 + at))
        seen, top = max(1, self.size.height - 1), self.scroll_offset.y
        self.scroll_to(y=max(min(top, at), at - seen + 1), animate=False)
        self.post_message(self.RowChosen())

    def on_click(self, event: events.Click) -> None:
        if event.y:
            self.choose(self.scroll_offset.y + event.y - 1)

    def render_lines(self, crop: Region) -> list[Strip]:
        strips = super().render_lines(crop)
        if crop.y == 0:  # the titles stay
            strips[0] = self.make_line(0).crop(crop.x, crop.right)
        return strips

    def make_line(self, y: int) -> Strip:
        row = self.rows[y - 1] if 0 < y <= len(self.rows) else None
        if y and row is None:
            return Strip.blank(0)
        ground = self.ground
        if row is not None and y - 1 == self.cursor:
            ground = Style(reverse=True) if self.app.no_color else Style.parse("on #27548a")
        segments = []
        for column, width in room_for(self.size.width).items():
            text = printable(COLUMNS[column] if row is None else row.cells[column])
            text = text if len(text) <= width else f"{text[: width - 1]}…"
            text = text.ljust(width) if column in _LEFT_COLUMNS else text.rjust(width)
            segments.append(Segment(text + " " * _GAP, ground + self._style(row, column)))
        return Strip(segments).extend_cell_length(self.size.width, ground)

    def _style(self, row: ListRow | None, column: int) -> Style:
        if row is None:
            return Style.null() if self.app.no_color else Style(color="#8a8a8a")
        if self.app.no_color or column not in (1, _FRESH):
            return Style(bold=column == 0 and row.key.kind == DRIVER)
        if column == _FRESH:
            return Style.null() if row.is_fresh else Style(color=_PARTLY)
        return Style(color=_FINE if row.bad == GOOD and row.is_fresh else _COLOURS[row.bad])
