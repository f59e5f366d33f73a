"""The live view of ``skin-top`` with Textual: a list of drivers, buses and patches, and a picture of one of them."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from typing import ClassVar

from rich.console import JustifyMethod
from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Container, Horizontal, Vertical
from textual.widgets import DataTable, Footer, Static

from skinware.bridge_state import as_data, summary
from skinware.cli._painting import HeatMap, Palette, palette_for
from skinware.cli._picture import CHANGE, Picture, describe_sensor
from skinware.cli._top_help import Help
from skinware.cli._top_rows import COLUMNS, ListRow, RowKey, labels_of, lines_of, rows_of
from skinware.errors import NamespaceError
from skinware.memory.namespace import Namespace
from skinware.state import LIVE, life_of
from skinware.tactile.regions import Regions
from skinware.text import NOT_FRESH, counters_text, plural, printable
from skinware.views.live import LiveDriver, Overview

_REDRAWS_HZ = 15
_LIST_PERIOD_S = 0.5
_MOST_CONTACTS = 9
"""Lines of contacts, where there is room."""
_WIDTHS = (19, 10, 8, 6, 11, 7, 7, 60)
_LEFT_COLUMNS = (0, 1, 7)
_STATE_COLOURS = {
    "live": "#6cc070",
    "connecting": "#5fb3d9",
    "starting": "#5fb3d9",
    "expected": "#5fb3d9",
    "restarted": "#5fb3d9",
    "paused": "#5fb3d9",
    "stale": "#e6c440",
    "silent": "#e6c440",
    NOT_FRESH: "#e8453c",
    "down": "#e8453c",
    "gone": "#e8453c",
    "dead": "#e8453c",
}
_LINES = ("head", "why", "title", "scale", "contacts", "marks", "detail")
_ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_NOTHING = """\
No driver runs in namespace {name!r} now.

Start one in another terminal, for example:

  skin-driver --bus virtual    an emulated skin, needs no hardware
  skin-driver --bus can0       ROBOSKIN patches on a CAN bus

It appears here when it runs.  q quits."""


class SkinTop(App[None]):
    """Show drivers, buses and patches, and a picture of the sensors under the cursor.

    Args:
        type_name: type of sensors to draw first; default: each driver's first.
        duration_s: end after this time; None: only by a key or signal.
        scale_name: the first meaning of the colours: ``change``, ``range`` or ``raw``.
        palette: default: the best that the terminal can show.
        regions: that a person may choose from; None: there are none.
        region: draw only sensors in this one at first; None: all.
    """

    TITLE = "skin-top"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    Screen { background: #121212; }
    #head { height: 1; background: #22304f; color: #e0e0e0; padding: 0 1; }
    #nothing { height: 1fr; align: center middle; }
    #why { width: auto; max-width: 76; padding: 1 3; border: round #27548a; }
    #all { height: 1fr; }
    #list {
        height: auto; max-height: 45%; background: #121212; overflow-x: hidden; scrollbar-size-vertical: 1;
    }
    #list > .datatable--header { background: #121212; color: #8a8a8a; text-style: none; }
    #list > .datatable--cursor { background: #27548a; text-style: none; }
    #above { height: 1; background: #22304f; color: #e0e0e0; padding: 0 1; }
    #title { width: 1fr; text-style: bold; }
    #scale { width: auto; }
    #map { height: 1fr; margin: 0 1; background: #121212; scrollbar-size-vertical: 1; }
    #contacts { height: 20%; min-height: 2; max-height: 9; padding: 0 1; }
    #marks, #detail { height: 1; padding: 0 1; }
    #detail { color: #8a8a8a; }
    Footer { background: #22304f; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", show=False, priority=True),
        Binding("down", "choose(1)", "Choose", key_display="↑↓"),
        Binding("up", "choose(-1)", show=False),
        Binding("t", "next_type", "Type"),
        Binding("s", "next_scale", "Scale"),
        Binding("r", "next_region", "Region"),
        Binding("b", "take_baselines", "Baseline"),
        Binding("pagedown", "scroll(1)", "Scroll", key_display="PgUp/PgDn"),
        Binding("pageup", "scroll(-1)", show=False),
        Binding("question_mark", "explain", "Help", key_display="?"),
    ]

    def __init__(
        self,
        namespace: Namespace,
        type_name: str | None = None,
        duration_s: float | None = None,
        *,
        scale_name: str = CHANGE,
        palette: Palette | None = None,
        regions: Regions | None = None,
        region: str | None = None,
    ) -> None:
        super().__init__()
        palette = palette or palette_for(self.console.color_system, no_color=self.no_color)
        self._overview = Overview(namespace)
        self._duration_s = duration_s
        self._picture = Picture(type_name, scale_name, palette, regions=regions, region=region)
        self._table = DataTable[Text](id="list", cursor_type="row")
        self._heat_map = HeatMap(palette, id="map")
        self._lines = {name: Static(id=name, markup=False) for name in _LINES}
        self._rows: list[ListRow] = []
        self._heading = ""
        self._pointed: int | None = None
        self._missed: RowKey | None = None  # the chosen row, while its driver is away
        self._must_draw = True

    def compose(self) -> ComposeResult:
        yield self._lines["head"]
        with Container(id="nothing"):
            yield self._lines["why"]
        with Vertical(id="all"):
            self._table.can_focus = False  # keys go to the app wherever the focus is
            yield self._table
            with Horizontal(id="above"):
                yield self._lines["title"]
                yield self._lines["scale"]
            yield self._heat_map
            self._lines["contacts"].display = False
            yield self._lines["contacts"]
            yield self._lines["marks"]
            yield self._lines["detail"]
        yield Footer()

    def on_mount(self) -> None:
        for column, title in enumerate(COLUMNS):
            self._table.add_column(_cell(title, column), key=title, width=_WIDTHS[column])
        loop = asyncio.get_running_loop()
        for number in _ENDING_SIGNALS:
            with contextlib.suppress(ValueError, RuntimeError):  # not in the main thread
                loop.add_signal_handler(number, self.exit)
        self._update_list()
        self.set_interval(_LIST_PERIOD_S, self._update_list)
        self.set_interval(1 / _REDRAWS_HZ, self._update_picture)
        if self._duration_s is not None:
            self.set_timer(self._duration_s, self.exit)

    def on_unmount(self) -> None:
        for number in _ENDING_SIGNALS:
            asyncio.get_running_loop().remove_signal_handler(number)
        self._overview.close()

    def action_choose(self, step: int) -> None:
        self._missed = None
        self._table.move_cursor(row=self._table.cursor_row + step)

    def action_explain(self) -> None:
        self.push_screen(Help())

    def action_scroll(self, pages: int) -> None:
        self._heat_map.scroll_relative(y=pages * max(1, self._heat_map.size.height - 1), animate=False)

    def action_next_type(self) -> None:
        row = self._chosen
        driver = self._driver_of(row) if row else None
        if driver is not None:
            self._picture.next_type(driver.reader.structure)
            self._must_draw = True

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:  # noqa: ARG002 - Textual's
        return self._picture.regions is not None or action != "next_region"

    def action_next_scale(self) -> None:
        self._picture.next_scale()
        self._must_draw = True

    def action_next_region(self) -> None:
        self._picture.next_region()
        self._must_draw = True

    def action_take_baselines(self) -> None:
        self._picture.take_baselines()
        self._must_draw = True

    def on_data_table_row_highlighted(self) -> None:
        self._pointed = None
        self._must_draw = True

    def on_data_table_row_selected(self) -> None:
        self._missed = None

    def on_heat_map_pointed(self, event: HeatMap.Pointed) -> None:
        self._pointed = event.sensor
        self._must_draw = True

    def on_resize(self) -> None:
        self._must_draw = True  # the next layout changes the space for the picture

    @property
    def _chosen(self) -> ListRow | None:
        at = self._table.cursor_row
        return self._rows[at] if 0 <= at < len(self._rows) else None

    def _driver_of(self, row: ListRow) -> LiveDriver | None:
        return self._overview.drivers.get(row.key.driver)

    def _say(self, where: str, text: str | Text) -> None:
        """Show a text, which may come from others, in a line of the screen."""
        line, text = self._lines[where], _printable(text)
        if line.content != text:
            line.update(text)

    def _update_list(self) -> None:
        if not self._lines["detail"].is_attached:
            return  # the screen is being taken down
        namespace = self._overview.drivers.namespace.name
        rows: list[ListRow] = []
        why = _NOTHING.format(name=namespace)
        heading = ["skin-top", f"namespace {namespace}"]
        try:
            drivers = self._overview.look()
            rows = [row for driver in drivers for row in rows_of(driver.report())]
            heading += [plural(len(drivers), "driver")]
            heading += [summary(bridge.robot, as_data(bridge)) for bridge in self._overview.bridges.states()]
        except NamespaceError as error:
            why = str(error)
        self._heading = "   ".join(heading)
        self._say("why", why)
        self.query("#nothing").set(display=not rows)
        self.query("#all").set(display=bool(rows))
        self._fill(rows)
        self._say("head", "   ".join([self._heading, *self._hidden_rows()]))
        self._must_draw = True  # counters and ages change without a snapshot

    def _hidden_rows(self) -> list[str]:
        """Return how many rows of the list are above and below those that are seen."""
        seen = max(0, self._table.size.height - 1)  # without the titles
        if not self._rows or not seen:
            return []
        above = min(int(self._table.scroll_offset.y), len(self._rows))
        below = max(0, len(self._rows) - above - seen)
        return [f"↑ {above} more"] * bool(above) + [f"↓ {below} more"] * bool(below)

    def _fill(self, rows: list[ListRow]) -> None:
        table, before = self._table, self._rows
        wanted = self._missed or (self._chosen.key if self._chosen else None)
        keys = [row.key for row in rows]
        self._rows = rows
        if keys != [row.key for row in before]:
            table.clear()
            for row in rows:
                table.add_row(*_cells(row), key=_text_key(row.key))
            is_here = wanted in keys
            self._missed = None if is_here else wanted
            if wanted is not None and is_here:
                table.move_cursor(row=keys.index(wanted))
            return
        for row, old in zip(rows, before, strict=True):
            for column, title in enumerate(COLUMNS):
                if row.cells[column] != old.cells[column]:
                    table.update_cell(_text_key(row.key), title, _cells(row)[column])

    def _update_picture(self) -> None:
        row, size = self._chosen, self._heat_map.size
        driver = self._driver_of(row) if row else None
        if row is None or driver is None or not size.area or not self._lines["detail"].is_attached:
            return
        is_newer = self._overview.drivers.poll(driver)
        frame, picture = driver.frame, self._picture
        if frame is None or not (is_newer or self._must_draw):
            return
        self._must_draw = False
        picture.draw(row.key, frame, size.width, size.height, LIVE if is_newer else life_of(driver.reader, frame))
        self._show_contacts(driver)
        hidden = 0 if picture.arrangement is None else picture.arrangement.lines - size.height
        self._say("title", picture.title + f" (PgUp, PgDn: {plural(hidden, 'more line')})" * (hidden > 0))
        self._say("scale", picture.scale)
        self._say("marks", picture.marks)
        if self._pointed is not None and self._pointed < frame.structure.n_sensors:
            regions = picture.regions_of(driver.name, self._pointed)
            self._say("detail", describe_sensor(frame, self._pointed) + f"; in {', '.join(regions)}" * bool(regions))
        else:
            self._say("detail", counters_text(row.counters))

    def _show_contacts(self, driver: LiveDriver) -> None:
        """Show the picture with the contacts over it, and a line for each contact."""
        contacts, panel = self._overview.contacts_on(driver), self._lines["contacts"]
        panel.display = contacts is not None
        places = contacts or []
        self._say("contacts", "\n".join(lines_of(places, panel.size.height or _MOST_CONTACTS)))
        arrangement = self._picture.arrangement
        if arrangement is not None:
            self._heat_map.show(arrangement, self._picture.pixels, labels_of(places, arrangement))


def _printable(text: str | Text) -> str | Text:
    """Return a text of others as :func:`skinware.text.printable` does; its colours stay."""
    if isinstance(text, str):
        return printable(text, "\n")
    text.plain = printable(text.plain, "\n")
    return text


def _cells(row: ListRow) -> list[Text]:
    cells = [_cell(text, column) for column, text in enumerate(row.cells)]
    cells[1].stylize(_STATE_COLOURS.get(row.state, ""))
    if row.key.kind == "driver":
        cells[0].stylize("bold")
    fresh, _, total = row.cells[4].partition("/")
    if fresh != total:
        cells[4].stylize(_STATE_COLOURS["stale"])
    return cells


def _cell(text: str, column: int) -> Text:
    justify: JustifyMethod = "left" if column in _LEFT_COLUMNS else "right"
    return Text(printable(text), justify=justify, no_wrap=True, overflow="ellipsis")


def _text_key(key: RowKey) -> str:
    return f"{key.driver} {key.kind} {key.number}"
