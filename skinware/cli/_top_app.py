"""The live view of ``skin-top``, with Textual: drivers and patches above, the chosen patch below."""

from __future__ import annotations

from typing import ClassVar

from textual.app import App, ComposeResult
from textual.containers import VerticalScroll
from textual.widgets import DataTable, Footer, Static

from skinware.cli._skin_view import driver_line, heat_map, patch_rows
from skinware.errors import ServiceTimeout, SkinwareError, StructureError
from skinware.memory.namespace import Namespace
from skinware.skin import Skin, Snapshot

_COLUMNS = ("driver", "bus", "patch", "state", "age ms", "fresh", "orphans", "updates")


class SkinTop(App[None]):
    """Drivers, patches and the touch on the patch under the cursor."""

    CSS = """
    #drivers { height: auto; padding: 0 1; background: $panel; }
    #patches { height: auto; max-height: 40%; }
    #map { height: auto; padding: 1 1 0 1; }
    """
    BINDINGS: ClassVar = [("q", "quit", "Quit"), ("t", "next_type", "Next sensor type")]
    TITLE = "skin-top"

    def __init__(self, namespace: Namespace, type_name: str, duration_s: float | None, redraws_hz: float) -> None:
        super().__init__()
        self._skin = Skin(namespace)
        self._type_name = type_name
        self._duration_s = duration_s
        self._period_s = 1 / redraws_hz
        self._snapshot: Snapshot | None = None
        self._patches: list[tuple[int, int]] = []
        self._layout: object = None

    def compose(self) -> ComposeResult:
        """Lay the screen out."""
        yield Static(id="drivers", markup=False)
        yield DataTable(id="patches", cursor_type="row", zebra_stripes=True)
        with VerticalScroll():
            yield Static(id="map")
        yield Footer()

    def on_mount(self) -> None:
        """Start to read."""
        table = self.query_one(DataTable)
        for name in _COLUMNS:
            table.add_column(name, key=name)
        table.focus()
        self.set_interval(self._period_s, self._refresh)
        if self._duration_s is not None:
            self.set_timer(self._duration_s, self.exit)

    def on_unmount(self) -> None:
        """Let go of the drivers."""
        self._skin.close()

    def action_next_type(self) -> None:
        """Draw another type of sensors."""
        types = self._snapshot.layout.types if self._snapshot else ()
        if types:
            at = types.index(self._type_name) + 1 if self._type_name in types else 0
            self._type_name = types[at % len(types)]

    def _refresh(self) -> None:
        drivers = self.query_one("#drivers", Static)
        try:
            snapshot = self._skin.read(timeout_s=0.0)
        except ServiceTimeout as silence:
            self._snapshot, self._layout = None, None
            self.query_one(DataTable).clear()
            self.query_one("#map", Static).update("")
            drivers.update(str(silence))
            return
        except SkinwareError as error:
            drivers.update(str(error))
            return
        lines = [
            driver_line(self._skin.reader(name), frame)
            for name, frame in zip(snapshot.layout.drivers, snapshot.frames, strict=True)
        ]
        drivers.update("\n".join(lines))
        self._snapshot = snapshot
        self._fill_table(snapshot)
        self._draw_map(snapshot)

    def _fill_table(self, snapshot: Snapshot) -> None:
        table = self.query_one(DataTable)
        rows = []
        patches = []
        for driver, name in enumerate(snapshot.layout.drivers):
            for patch, row in enumerate(patch_rows(self._skin.reader(name), snapshot.frames[driver])):
                rows.append((name, *row))
                patches.append((driver, patch))
        if self._layout is not snapshot.layout:
            table.clear()
            for number, row in enumerate(rows):
                table.add_row(*row, key=str(number))
            self._layout = snapshot.layout
            self._patches = patches
            return
        for number, row in enumerate(rows):
            for column, cell in zip(_COLUMNS, row, strict=True):
                if table.get_cell(str(number), column) != cell:
                    table.update_cell(str(number), column, cell)

    def _draw_map(self, snapshot: Snapshot) -> None:
        cursor = self.query_one(DataTable).cursor_row
        if not 0 <= cursor < len(self._patches):
            return
        driver, patch = self._patches[cursor]
        try:
            drawn = heat_map(snapshot.frames[driver], patch, self._type_name)
        except StructureError as error:
            self.query_one("#map", Static).update(str(error))
            return
        self.query_one("#map", Static).update(drawn)
