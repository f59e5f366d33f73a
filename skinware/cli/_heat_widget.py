"""A picture of a skin as a Textual widget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from textual import events
from textual.geometry import Size
from textual.message import Message
from textual.scroll_view import ScrollView
from textual.strip import Strip

from skinware.cli._heat_map import Arrangement, Label
from skinware.cli._painting import Palette, changed_lines, segments_of


class HeatMap(ScrollView, can_focus=False):
    """A picture line by line, in the colours of a palette; only lines that changed are drawn again."""

    class Pointed(Message):
        """The mouse points at a sensor (its position in the frame), or at none."""

        def __init__(self, sensor: int | None) -> None:
            super().__init__()
            self.sensor = sensor

    def __init__(self, palette: Palette, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self._palette = palette
        self._arrangement: Arrangement | None = None
        self._pixels: npt.NDArray[np.uint8] | None = None
        self._marks: Mapping[int, Sequence[Label]] = {}
        self._strips: dict[int, Strip] = {}

    def show(
        self,
        arrangement: Arrangement,
        pixels: npt.NDArray[np.uint8],
        marks: Mapping[int, Sequence[Label]],
    ) -> None:
        """Draw what changed since the last time.

        Args:
            arrangement: where everything is.
            pixels: (2 * lines, columns) uint8, what ``arrangement.draw`` made; not changed afterwards.
            marks: words over sensors, by line.
        """
        before = self._pixels if arrangement is self._arrangement else None
        moved = {line for line in self._marks.keys() | marks.keys() if self._marks.get(line) != marks.get(line)}
        self._arrangement, self._pixels, self._marks = arrangement, pixels, marks
        if before is None:
            self._strips.clear()
            self.virtual_size = Size(arrangement.columns, arrangement.lines)
            self.refresh()
            return
        top = self.scroll_offset.y
        for line in moved.union(changed_lines(before, pixels)):
            self._strips.pop(line, None)
            if top <= line < top + self.size.height:
                self.refresh_line(line)

    def render_line(self, y: int) -> Strip:
        left, top = self.scroll_offset
        strip = self._strips.get(y + top) or self._strip(y + top)
        return strip.crop_extend(left, left + self.size.width, None).apply_style(self.rich_style)

    def _strip(self, line: int) -> Strip:
        arrangement, pixels = self._arrangement, self._pixels
        if arrangement is None or pixels is None or line >= arrangement.lines:
            return Strip.blank(0)
        upper, lower = pixels[2 * line : 2 * line + 2]
        labels = [*arrangement.labels.get(line, ()), *self._marks.get(line, ())]
        segments = segments_of(upper, lower, labels, self._palette)
        strip = self._strips[line] = Strip(segments, arrangement.columns)
        return strip

    def on_mouse_move(self, event: events.MouseMove) -> None:
        if self._arrangement is not None:
            left, top = self.scroll_offset
            self.post_message(self.Pointed(self._arrangement.sensor_at(event.y + top, event.x + left)))

    def on_leave(self) -> None:
        """The mouse points at nothing here any more."""
        self.post_message(self.Pointed(None))
