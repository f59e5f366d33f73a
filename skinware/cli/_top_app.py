"""The live view of ``skin-top`` with Textual: drivers, buses and patches, a picture of one, and its help."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import time
from collections.abc import Collection
from typing import ClassVar

import numpy as np
from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Container, Horizontal, Vertical, VerticalScroll
from textual.drivers.linux_driver import LinuxDriver
from textual.screen import ModalScreen, Screen
from textual.widgets import Footer, Static

from skinware.bridge_state import as_data, summary
from skinware.cli._painting import MARK_CHARACTERS, MARK_NAMES, HeatMap, Palette, palette_for
from skinware.cli._picture import CHANGE, Picture, describe_sensor
from skinware.cli._terminal import EndOfKeys
from skinware.cli._top_list import DriverList
from skinware.cli._top_rows import COLUMNS, ListRow, labels_of, lines_of, rows_of
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import NamespaceError
from skinware.memory.futex import Word, sleep_on
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.state import LIVE, life_of
from skinware.tactile.regions import Regions
from skinware.text import age_text, counters_text, plural, printable
from skinware.views.live import LiveDriver, Overview

_REDRAWS_HZ = 12
_SHARE, _LONGEST_REST_S = 0.035, 0.5
"""Part of a core that the program may use, and for how long at most pictures wait for that."""
_LIST_PERIOD_S, _LONGEST_SLEEP_NS = 1.0, 10 * NS_PER_S
_MOST_CONTACTS = 9
"""Lines of contacts, where there is room."""
_LOW = 20
"""Below this height, contacts are numbers in the picture only, and counters of a row are not shown."""
_FIXED = ("head", "title", "marks", "detail")
"""Lines whose text never moves anything else."""
_LINES = ("head", "why", "title", "scale", "contacts", "marks", "detail")
_ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_NOTHING = """\
No{what}.

Start one in another terminal, for example:

  skin-driver --bus virtual    an emulated skin, needs no hardware
  skin-driver --bus can0       ROBOSKIN patches on a CAN bus

It appears here when it runs.  q quits."""
_MEANINGS = (
    "a driver, its buses, and the patches on each",
    "live, or what is wrong; a driver that hangs is silent",
    "snapshots a second of a driver, updates of a patch",
    "time since the newest value was measured",
    "sensors with a good and new value, of all",
    "frames thrown away before the driver read them",
    "frames of no update that the driver could complete",
    "other counts of the row; all are below the picture",
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
        marks = {MARK_CHARACTERS[mark]: name for mark, name in MARK_NAMES.items()}
        columns = dict(zip(COLUMNS, _MEANINGS, strict=True))
        parts = {"Columns": columns, "Marks over sensors": marks, "Reasons, beside skin-calm": REASONS, "Keys": KEYS}
        lines = []
        for title, meanings in parts.items():
            lines += ["", title, *(f"  {name:<18} {meaning}" for name, meaning in meanings.items())]
        with VerticalScroll():
            yield Static("\n".join(lines[1:]), markup=False)


class _Blank(Vertical):
    BLANK = True  # nothing of its own is drawn


class _BlankScreen(Screen[None]):
    BLANK = True


class _Bell:
    """Wakes what sleeps on its futex in another thread, or waits for ``rung`` in the loop."""

    def __init__(self) -> None:
        self.rung = asyncio.Event()
        self._count = np.zeros(1, np.uint32)
        self._word = Word(self._count.view(np.uint8), 0)

    @property
    def wake_word(self) -> tuple[Word, int]:
        return self._word, int(self._count[0])

    def ring(self) -> None:
        self.rung.set()
        self._count += 1
        self._word.wake_all()


class SkinTop(App[None]):
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
    .-low #list { max-height: 40%; }
    #above { height: 1; background: #22304f; color: #e0e0e0; padding: 0 1; }
    #title { width: 1fr; padding-right: 1; text-style: bold; }
    #scale { width: auto; }
    #map { height: 1fr; margin: 0 1; background: #121212; scrollbar-size-vertical: 1; }
    #contacts { height: 20%; min-height: 2; max-height: 9; padding: 0 1; }
    #marks, #detail { height: 1; padding: 0 1; }
    #detail { color: #8a8a8a; }
    Footer { background: #22304f; }
    """
    VERTICAL_BREAKPOINTS = [(0, "-low"), (_LOW, "-high")]  # noqa: RUF012 - its class declares it so
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("question_mark", "explain", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", show=False, priority=True),
        Binding("down", "choose(1)", "Choose", key_display="↑↓"),
        Binding("up", "choose(-1)", show=False),
        Binding("t", "next_type", "Type"),
        Binding("s", "picture('next_scale')", "Scale"),
        Binding("r", "picture('next_region')", "Region"),
        Binding("o", "next_order", "Order"),
        Binding("b", "picture('take_baselines')", "Baseline"),
        Binding("pagedown", "scroll(1)", "Scroll", key_display="PgUp/PgDn"),
        Binding("pageup", "scroll(-1)", show=False),
    ]

    def __init__(
        self,
        namespace: Namespace,
        names: Collection[str] = (),
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
        self._overview = Overview(namespace, names)
        self._duration_s = duration_s
        self._picture = Picture(type_name, scale_name, palette, regions=regions, region=region)
        self._list = DriverList(id="list")
        self._heat_map = HeatMap(palette, id="map")
        self._lines = {name: Static(id=name, markup=False) for name in _LINES}
        self._is_worst_first = True
        self._pointed: int | None = None
        self._bell, self._must_draw = _Bell(), True
        self._drawn: DriverSnapshot | None = None
        self._listed: tuple[object, ...] = ()
        self._drawn_s = 0.0, 0.0  # by the clock, and of the processor

    def get_default_screen(self) -> Screen[None]:
        return _BlankScreen(id="_default")

    def compose(self) -> ComposeResult:
        yield self._lines["head"]
        with Container(id="nothing"):
            yield self._lines["why"]
        with _Blank(id="all"):
            yield self._list
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
        loop = asyncio.get_running_loop()
        for number in _ENDING_SIGNALS:
            with contextlib.suppress(ValueError, RuntimeError):  # not in the main thread
                loop.add_signal_handler(number, self.exit)
        if isinstance(self._driver, LinuxDriver):
            self._driver.exit_event = EndOfKeys(self._driver.fileno)
        self._update_list()
        self.set_interval(_LIST_PERIOD_S, self._update_list)
        self._following = asyncio.create_task(self._follow())
        if self._duration_s is not None:
            self.set_timer(self._duration_s, self.exit)

    def on_unmount(self) -> None:
        for number in _ENDING_SIGNALS:
            asyncio.get_running_loop().remove_signal_handler(number)
        self._following.cancel()
        self._draw_soon()  # which ends its wait
        self._overview.close()

    def action_choose(self, step: int) -> None:
        self._list.choose(min(max(self._list.cursor + step, 0), len(self._list.rows) - 1))

    def action_next_order(self) -> None:
        self._is_worst_first = not self._is_worst_first
        self._update_list()

    def action_explain(self) -> None:
        self.push_screen(Help())

    def action_scroll(self, pages: int) -> None:
        self._heat_map.scroll_relative(y=pages * max(1, self._heat_map.size.height - 1), animate=False)

    def action_next_type(self) -> None:
        row = self._list.chosen
        driver = self._driver_of(row) if row else None
        if driver is not None:
            self._picture.next_type(driver.reader.structure)
            self._draw_soon()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:  # noqa: ARG002 - Textual's
        return self._picture.regions is not None or parameters != ("next_region",)

    def action_picture(self, change: str) -> None:
        getattr(self._picture, change)()
        self._draw_soon()

    def on_driver_list_row_chosen(self) -> None:
        self._pointed = None
        self._draw_soon()

    def on_heat_map_pointed(self, event: HeatMap.Pointed) -> None:
        self._pointed = event.sensor
        self._draw_soon()

    def on_resize(self) -> None:
        self._draw_soon()  # the next layout changes the space for the picture

    def _draw_soon(self) -> None:
        self._must_draw = True
        self._bell.ring()

    async def _follow(self) -> None:
        """Draw the picture whenever the chosen driver publishes, or something asks for it; else sleep."""
        while True:
            driver = self._driver_of(self._list.chosen) if self._list.chosen else None
            words = [self._bell.wake_word, *([] if driver is None else [driver.wake_word])]
            self._bell.rung.clear()
            self._update_picture()
            await asyncio.to_thread(sleep_on, words, now_ns() + _LONGEST_SLEEP_NS)
            await asyncio.sleep(1 / _REDRAWS_HZ)
            drawn_s, used_s = self._drawn_s
            rest_s = drawn_s + min((time.process_time() - used_s) / _SHARE, _LONGEST_REST_S) - time.monotonic()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._bell.rung.wait(), max(0.0, rest_s))

    def _driver_of(self, row: ListRow) -> LiveDriver | None:
        return self._overview.drivers.get(row.key.driver)

    def _say(self, where: str, text: str | Text) -> None:
        line, text = self._lines[where], _printable(text)
        if line.content != text:
            line.update(text, layout=where not in _FIXED and len(str(line.content)) != len(str(text)))

    def _update_list(self) -> None:
        if not self._lines["detail"].is_attached:
            return  # the screen is being taken down
        namespace = self._overview.drivers.namespace.name
        rows: list[ListRow] = []
        why = ""
        heading = ["skin-top", f"namespace {namespace}"]
        try:
            drivers = self._overview.look()
            state = (self._is_worst_first, self.size, self._list.scroll_offset, *map(_state_of, drivers))
            if state == self._listed and not self._overview.bridges.readers:
                return
            self._listed = state
            reports = [driver.report() for driver in drivers]
            if self._is_worst_first:
                reports.sort(key=lambda report: -report.worst)
            rows = [row for report in reports for row in rows_of(report, worst_first=self._is_worst_first)]
            if not drivers:
                why = _NOTHING.format(what=self._overview.nothing.removeprefix("no"))
            heading += [plural(len(drivers), "driver")]
            heading += [summary(bridge.robot, as_data(bridge)) for bridge in self._overview.bridges.states()]
        except NamespaceError as error:
            why, self._listed = str(error), ()
        self._say("why", why)
        self.query("#nothing").set(display=not rows)
        self.query("#all").set(display=bool(rows))
        before = self._list.chosen and self._list.chosen.ageless()
        self._list.show(rows)
        self._say("head", "   ".join([*heading, *self._hidden_rows()]))
        if before != (self._list.chosen and self._list.chosen.ageless()):
            self._draw_soon()

    def _hidden_rows(self) -> list[str]:
        rows, seen = len(self._list.rows), max(0, self._list.size.height - 1)  # without the titles
        if not rows or not seen:
            return []
        above = min(int(self._list.scroll_offset.y), rows)
        below = max(0, rows - above - seen)
        return [f"↑ {above} more"] * bool(above) + [f"↓ {below} more"] * bool(below)

    def _update_picture(self) -> None:
        row, size = self._list.chosen, self._heat_map.size
        driver = self._driver_of(row) if row else None
        if row is None or driver is None or not size.area or not self._lines["detail"].is_attached:
            return
        self._overview.drivers.poll(driver)
        frame, picture = driver.frame, self._picture
        is_newer, self._drawn = frame is not self._drawn, frame
        if frame is None or not (is_newer or self._must_draw):
            return
        self._must_draw, self._drawn_s = False, (time.monotonic(), time.process_time())
        picture.draw(row.key, frame, size.width, size.height, LIVE if is_newer else life_of(driver.reader, frame))
        self._show_contacts(driver)
        hidden = 0 if picture.arrangement is None else picture.arrangement.lines - size.height
        self._say("title", picture.title + f" (PgUp, PgDn: {plural(hidden, 'more line')})" * (hidden > 0))
        self._say("scale", picture.scale)
        self._say("marks", picture.marks)
        self._lines["detail"].display = self._pointed is not None or self.size.height >= _LOW
        if self._pointed is not None and self._pointed < frame.structure.n_sensors:
            regions = picture.regions_of(driver.name, self._pointed)
            self._say("detail", describe_sensor(frame, self._pointed) + f"; in {', '.join(regions)}" * bool(regions))
        else:
            self._say("detail", counters_text(row.counters))

    def _show_contacts(self, driver: LiveDriver) -> None:
        contacts, panel = self._overview.contacts_on(driver), self._lines["contacts"]
        panel.display = contacts is not None and self.size.height >= _LOW
        places = contacts or []
        self._say("contacts", "\n".join(lines_of(places, panel.size.height or _MOST_CONTACTS)))
        arrangement = self._picture.arrangement
        if arrangement is not None:
            self._heat_map.show(arrangement, self._picture.pixels, labels_of(places, arrangement))


def _state_of(driver: LiveDriver) -> tuple[object, ...]:
    """Return what rows of a driver are made of; no age of a part changes before that of the driver."""
    frame = driver.frame
    return driver.name, life_of(driver.reader, frame), frame, None if frame is None else age_text(frame.age_ns)


def _printable(text: str | Text) -> str | Text:
    if isinstance(text, str):
        return printable(text, "\n")
    text.plain = printable(text.plain, "\n")
    return text
