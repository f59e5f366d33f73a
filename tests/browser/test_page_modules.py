"""The modules of the page that compute something, each by itself, in the browser that runs them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route

from skinware.state import GONE, OLD, badness
from skinware.text import age_text, count_text, measure_text, rate_text
from tests.browser.browsing import PATIENCE_MS
from tests.browser.fake_server import PAGE

ORIGIN = "http://127.0.0.1/"
NONE = "\N{EN DASH}"
"""Where a figure is not known."""


def serve(route: Route) -> None:
    name = route.request.url.removeprefix(ORIGIN)
    kind, text = ("javascript", (PAGE / name).read_text()) if name else ("html", "<p>empty")
    route.fulfill(content_type=f"text/{kind}", body=text)


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Page]:
    """An empty page that can import the modules; nothing serves it."""
    context = browser.new_context()
    context.set_default_timeout(PATIENCE_MS)
    context.route(f"{ORIGIN}**", serve)
    page = context.new_page()
    page.goto(ORIGIN)
    yield page
    context.close()


@pytest.fixture
def tell(page: Page) -> Callable[..., Any]:
    """``tell(module, expression, *arguments)``: of the names that a module exports; ``a`` are the arguments."""

    def tell(module: str, expression: str, *arguments: object) -> Any:
        script = f"async (a) => {{ const m = await import('/{module}'); return ({expression}) }}"
        return page.evaluate(script, list(arguments))

    return tell


HAND = """(() => {
    const names = ["index tip", "index pad", "thumb tip", "thumb pad", "palm"];
    const at = [[0, 5], [0, 3], [3, 5], [3, 3], [1.5, 0]];
    const driver = { name: "hand", patches: [{ name: "right hand" }] };
    driver.modules = names.map((name) => ({ name: `right hand, ${name}`, patch: 0 }));
    const places = at.flatMap(([x, y]) => [[x, y, 0], [x + 1, y + 1, 0]]).flat();
    const sheet = { driver, n: 10, unit: "N", position: places, radius: Array(10).fill(0.1) };
    Object.assign(sheet, { normal: Array(10).fill([0, 0, 1]).flat(), patch: Array(10).fill(0) });
    sheet.module = Array.from({ length: 10 }, (_, i) => i >> 1);
    sheet.shown = { totals: a[1], scale: [0, 1] };
    const stage = { pixels: 100, width: 2000, camera: { position: { toArray: () => [2, 3, a[2]] } } };
    stage.project = (x, y, z) => [a[0] * 100 * x + (a[3] ?? 500), 1500 - a[0] * 100 * y, 1 / a[0]];
    const found = new m.Names();
    found.arrange([sheet]);
    return found.place(stage, a[4] ?? []);
})()"""


def test_parts_of_a_hand_have_names_and_totals_where_there_is_room(tell: Callable[..., Any]) -> None:
    near = tell("names.js", HAND, 1, None, 9)
    pads = ["index pad", "index tip", "palm", "thumb pad", "thumb tip"]
    assert sorted(name["text"] for name in near) == sorted([*pads, "index", "thumb", "right hand"])
    for one, other in pairwise(sorted(near, key=lambda name: name["y"])):
        assert abs(one["y"] - other["y"]) >= 14 or abs(one["x"] - other["x"]) >= (one["width"] + other["width"]) / 2
    loaded = tell("names.js", HAND, 2, [1.5, 0, 0, 0, 2], 9)
    assert {"index tip  1.5 N", "index  1.5 N", "palm  2 N", "right hand  3.5 N", "thumb"} <= {
        n["text"] for n in loaded
    }
    assert [name["text"] for name in tell("names.js", HAND, 0.07, None, 9)] == ["right hand"]
    assert tell("names.js", HAND, 0.02, None, 9) == []
    assert tell("names.js", HAND, 1, None, -9) == []  # from behind
    thumb = ["palm", "right hand", "thumb", "thumb pad", "thumb tip"]
    assert sorted(name["text"] for name in tell("names.js", HAND, 1, None, 9, -250)) == thumb
    assert tell("names.js", HAND, 1, None, 9, -500) == []  # beside the picture


def test_no_pad_is_named_over_a_contact(tell: Callable[..., Any]) -> None:
    names = {name["text"]: name for name in tell("names.js", HAND, 1, None, 9)}
    at, beside = names["index pad"], names["index pad"]["width"] / 2
    rings = [(0, 0, 10, True), (beside + 9, 0, 10, True), (0, -16, 10, True), (0, 0, 0, False)]  # 0: behind the eye
    rings += [(beside + 11, 0, 10, False), (0, 18, 10, False), (beside + 8, 15, 10, False)]
    for right, down, size, is_over in rings:
        ring = {"x": at["x"] + right, "y": at["y"] + down, "size": size}
        left = {name["text"] for name in tell("names.js", HAND, 1, None, 9, None, [ring])}
        assert set(names) - left == ({"index pad"} if is_over else set()), ring


WIDTH = """(() => {
    const { prototype } = CanvasRenderingContext2D, { measureText } = prototype;
    prototype.measureText = ({ length }) => ({ width: length ** 2 });
    try { return m.widthOf("\u0416".repeat(4)); } finally { prototype.measureText = measureText; }
})()"""


def test_a_browser_measures_characters_not_texts_which_it_would_remember(tell: Callable[..., Any]) -> None:
    assert tell("names.js", WIDTH) == 4


TURN = """(() => {
    const text = new TextEncoder().encode(a[0]);
    const bytes = new Uint8Array(a[1] + 24);
    new DataView(bytes.buffer).setUint32(0, a[1] - 4, true);
    bytes.fill(32, 4, a[1]); bytes.set(text, 4);
    new DataView(bytes.buffer).setFloat32(a[1] + 8, 2.5, true);
    bytes[a[1] + 2] = 7;
    const { header, blob } = m.decode(bytes.buffer);
    const numbers = (where, Kind) => [...blob(where, Kind)];
    return [header.turn, numbers([0, 3], Uint8Array), numbers([8, 4], Float32Array)];
})()"""


def test_a_turn_is_taken_apart(tell: Callable[..., Any]) -> None:
    for size in (24, 32):
        assert tell("turn.js", TURN, '{"turn": 3}', size) == [3, [0, 0, 7], [2.5]]


def test_every_status_has_the_mark_that_says_most(tell: Callable[..., Any]) -> None:
    names = tell("marks.js", "Array.from({length: 256}, (_, status) => m.MARKS[m.markOf(status)].name)")
    assert names[0] == "fresh"
    assert [names[1 << bit] for bit in range(8)] == [
        "never seen",
        "stale",
        "out of range",
        "no answer",
        "not connected",
        "switched off",
        "suspect",
        "unhealthy",
    ]
    assert names[254] == "not connected"
    assert names[255] == "settling"
    assert names[2 | 4] == "stale"
    assert tell("marks.js", "m.statusText(6)") == "stale, out of range"


FILL = """(() => {
    const marks = new Uint8Array(5);
    const how = { dimmed: a[0] && Uint8Array.from(a[0]), isOld: a[1], isWipe: a[2] };
    const levels = Uint8Array.from([9, 255, 250, 9, 249]);
    const fill = () => m.fillMarks(Uint8Array.from([0, 0, 0, 1, 0]), levels, marks, how);
    const first = fill();
    return [first, fill(), [...marks].map(mark => m.MARKS[mark & ~m.DIMMED].name + (mark & m.DIMMED ? '-' : ''))];
})()"""


@pytest.mark.parametrize(
    ("dimmed", "is_old", "is_wipe", "marks"),
    [
        (None, False, False, ["fresh", "no value", "fresh", "never seen", "fresh"]),
        (None, True, False, ["stale", "no value", "stale", "never seen", "stale"]),
        (None, False, True, ["not touched", "no value", "fresh", "never seen", "not touched"]),
        ([0, 1, 0, 1, 0], False, False, ["fresh", "no value-", "fresh", "never seen-", "fresh"]),
    ],
    ids=["now", "old", "wipe", "selected"],
)
def test_marks_of_taxels(
    tell: Callable[..., Any], dimmed: list[int] | None, is_old: bool, is_wipe: bool, marks: list[str]
) -> None:
    assert tell("marks.js", FILL, dimmed, is_old, is_wipe) == [True, False, marks]


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_each_level_is_farther_from_the_ground_in_grey(tell: Callable[..., Any], theme: str) -> None:
    """Told apart by brightness alone, by whoever sees few colours."""
    colours = tell("palette.js", "[...m.ramp(a[0])]", theme)
    luma = [0.2126 * colours[4 * i] + 0.7152 * colours[4 * i + 1] + 0.0722 * colours[4 * i + 2] for i in range(251)]
    rising = luma if theme == "dark" else luma[::-1]
    assert all(later >= earlier - 0.5 for earlier, later in pairwise(rising))
    assert all(later - earlier > 5 for earlier, later in pairwise(rising[::25]))


PAST = """(() => {
    const past = new m.Past(a[0]);
    const sheet = { status: new Uint8Array(1000), shear: null, scale: [0, 1], mode: 'raw' };
    for (let i = 0; i < 100; i++) {
        sheet.levels = new Uint8Array(1000).fill(i);
        if (i === 60) sheet.status = new Uint8Array(1000).fill(2);
        past.push(sheet, 1000 * i);
    }
    const level = at_ms => past.at(sheet, at_ms)?.levels[0] ?? null;
    const found = [past.oldest_ms, past.bytes, level(-5), level(95_400), level(1e9), past.at(sheet, 99_000).status[0]];
    past.keepOnly([]);
    return [...found, past.bytes, past.at(sheet, 95_000)];
})()"""


def test_the_past_is_kept_for_a_time_and_in_bounded_memory(tell: Callable[..., Any]) -> None:
    long, short = {"longest_ms": 30_000, "most_bytes": 1e9}, {"longest_ms": 1e9, "most_bytes": 10_500}
    assert tell("history.js", PAST, long) == [69_000, 31_000, 69, 95, 99, 2, 0, None]
    oldest, kept, *rest = tell("history.js", PAST, short)
    assert kept <= 10_500
    assert oldest == 90_000
    assert rest == [90, 95, 99, 2, 0, None]


def test_an_address_tells_the_view(tell: Callable[..., Any]) -> None:
    view = {
        "camera": {"position": [1, -2.5, 1e-7], "target": [0, 0, 3]},
        "mode": "peak",
        "type": "force",
        "scale": [-1, 12.5],
        "selected": "default/a b/can0/board #8&c",
        "pins": ["default/x:pressure:7a", "default/y:force:1"],
        "normals": True,
        "names": False,
        "theme": "light",
        "shifts": {"default/a b": [0.5, -1, 0]},
        "times": [1.5, 0.125],
        "plots": [
            [{"key": "taxel default/x:pressure:7a", "label": "a & b", "unit": "N", "taxel": "default/x:pressure:7a"}]
        ],
    }
    assert tell("address.js", "m.fromHash(m.toHash(a[0]))", view) == view | {"flat": False, "sharp": False}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "#",
        "#eye=1,2",
        "#eye=1,2,3,4,5,x&scale=1",
        "#eye=,,,,,&theme=pink&scale=a,b",
        "#%%%=&=&eye=1e999,1,1,1,1,1",
        "#plot=[1]&plot={&t=x",
    ],
)
def test_a_bad_address_is_no_view(tell: Callable[..., Any], text: str) -> None:
    found = tell("address.js", "m.fromHash(a[0])", text)
    assert [found["camera"], found["scale"], found.get("theme")] == [None, None, None]
    assert [found["pins"], found["plots"], found["times"]] == [[], [], None]


def test_a_line_shows_the_extremes_of_each_column(tell: Callable[..., Any]) -> None:
    """One sample among a thousand is not lost; what is not in the window is left out; a gap stays one."""
    window = "{from: 10, to: 20, width: 100}"
    line = f"m.piecesOf(Float64Array.from(a[0]), Float64Array.from(a[1], x => x ?? NaN), {window})"
    times = [8 + i * 0.01 for i in range(1301)]
    values: list[float | None] = [0.0] * 1301
    values[0], values[700], values[1000] = 99, 5, None
    before, after = tell("curves.js", line, times, values)
    points = [*before, *after]
    assert max(y for _, y in points) == 5
    assert all(-1 <= x <= 101 for x, _ in points)
    assert before[-1][0] <= 80 <= after[0][0]
    assert len(points) < 400
    few = tell("curves.js", line, times[700:710], [1, 2, None, 4, 5, 6, None, None, 9, 10])
    assert [[y for _, y in piece] for piece in few] == [[1, 2], [4, 5, 6], [9, 10]]
    assert tell("curves.js", line, [], []) == []
    assert tell("curves.js", f"m.rangeOf({line})", times, [None] * 1301) is None


def test_the_noise_of_a_line_has_no_slope_and_no_gaps(tell: Callable[..., Any]) -> None:
    series = [[*range(9)], [0, 1] * 500, [0, 1, None, 2], []]
    noises = tell("curves.js", "a[0].map((values) => m.noiseOf(Float64Array.from(values, x => x ?? NaN)))", series)
    assert noises == [0, pytest.approx(1 / np.sqrt(2), rel=0.01), None, None]


def test_ticks_are_round(tell: Callable[..., Any]) -> None:
    assert tell("curves.js", "m.ticksOf(-60, 0, 6)") == [-60, -50, -40, -30, -20, -10, 0]
    assert tell("curves.js", "m.ticksOf(0.012, 0.031, 4)") == [0.015, 0.02, 0.025, 0.03]
    assert tell("curves.js", "m.ticksOf(1, 1, 4)") == []


def test_a_line_keeps_a_minute_in_bounded_memory(tell: Callable[..., Any]) -> None:
    script = """(() => {
      const series = new m.Series();
      for (let k = 0; k < a[0]; k++) series.push(k * a[1], k);
      series.push(5, 5);
      return [series.times.length, series.values[0], series.values.at(-1), series.time_ns.length];
    })()"""
    assert tell("series.js", script, 100, 1e9) == [66, 34, 99, 2048]  # a sample a second, and some ahead
    assert tell("series.js", script, 300_000, 1e5) == [65_536, 300_000 - 65_536, 299_999, 131_072]


def test_a_spectrum_has_the_amplitude_at_its_frequency(tell: Callable[..., Any]) -> None:
    times = np.arange(1100) / 200 * 1e9 + 5e12
    values = 3 * np.sin(2 * np.pi * 12.5 * times / 1e9) + 7
    script = "m.spectrumOf(Float64Array.from(a[0]), Float64Array.from(a[1], x => x ?? NaN))"
    for gap in (None, 20):  # the longest piece counts
        told: list[float | None] = values.tolist()
        if gap is not None:
            told[gap] = None
        found = tell(
            "spectrum.js",
            f"(({{amplitude, ...more}}) => ({{...more, amplitude: [...amplitude]}}))({script})",
            times.tolist(),
            told,
        )
        amplitude = np.array(found["amplitude"])
        assert found["rate_hz"] == pytest.approx(200)
        assert found["step_hz"] * amplitude.argmax() == pytest.approx(12.5, abs=found["step_hz"])
        assert amplitude.max() == pytest.approx(3, rel=0.01)
        assert amplitude[abs(np.arange(len(amplitude)) * found["step_hz"] - 12.5) > 1].max() < 0.01
    assert tell("spectrum.js", script, times[:10].tolist(), values[:10].tolist()) is None


def test_figures(tell: Callable[..., Any]) -> None:
    assert tell("format.js", "[null, NaN].map(m.age)") == [NONE, NONE]
    figures = "[0, 1.23456, -120345.6, 1.5e-7, 12345678, 2.5e9, undefined].map(m.figure)"
    assert tell("format.js", figures) == ["0", "1.235", "-120,346", "1.50e-7", "12,345,678", "2.50e+9", NONE]
    assert tell("format.js", "[999, 1234, 4.2e7, 5e12, 9e15].map(m.bytes)") == [
        "999 B",
        "1.2 kB",
        "42.0 MB",
        "5.0 TB",
        "9000 TB",
    ]
    assert tell("format.js", "[0, 59.96, 125.25].map(m.clock)") == ["0:00.0", "1:00.0", "2:05.3"]


def test_ages_rates_and_counts_look_as_in_the_terminal(tell: Callable[..., Any]) -> None:
    ages_ms = [-5, 0, 0.04, 0.6, 9.9, 12.4, 999.6, 1234, 99_900, 200_000, 99 * 60_000, 7 * 3_600_000]
    assert tell("format.js", "a[0].map(m.age)", ages_ms) == [age_text(age_ms * 1e6) for age_ms in ages_ms]
    rates_hz = [0, 0.25, 1, 20.04, 999.9, 1000.2]
    assert tell("format.js", "a[0].map(m.rate)", rates_hz) == [rate_text(rate_hz) for rate_hz in rates_hz]
    counts = [0, 999, 30_848, 1_234_567]
    assert tell("format.js", "a[0].map(m.count)", counts) == [count_text(count) for count in counts]
    measures = [(101_600, "Pa"), (-999, "Pa"), (0, "Pa"), (2.5e-5, "T"), (0.0015, "m"), (0.002, "N"), (10_493, "")]
    assert tell("format.js", "a[0].map((one) => m.measure(...one))", measures) == [measure_text(*m) for m in measures]
    assert tell("format.js", "m.range(0, 150000, 'Pa')") == ["0", "150 kPa"]


TREE = """m.rowsOf(a[0], new Map(a[1])).map(function told(row) {
    return [row.key, row.bad, (row.children ?? []).map(told)];
})"""


def test_what_has_a_problem_is_first_in_the_tree(tell: Callable[..., Any]) -> None:
    def driver(number: int, patches: int) -> dict[str, Any]:
        of = [{"name": f"p{i}", "bus": i % 2} for i in range(patches)]
        return {"id": number, "key": f"d{number}", "name": f"d{number}", "buses": ["x", "y"], "patches": of}

    def state(*patches: str) -> dict[str, Any]:
        return {"buses": [{"bad": 0}] * 2, "patches": [{"state": one, "bad": badness(one)} for one in patches]}

    found = tell(
        "tree.js", TREE, [driver(0, 2), driver(1, 4)], [[0, state("live", "live")], [1, state(*["live"] * 3, "stale")]]
    )
    assert found == [
        [
            "d1",
            2,
            [
                ["d1/y", 2, [["d1/y/p3", 2, []], ["d1/y/p1", 0, []]]],
                ["d1/x", 0, [["d1/x/p0", 0, []], ["d1/x/p2", 0, []]]],
            ],
        ],
        ["d0", 0, [["d0/x", 0, [["d0/x/p0", 0, []]]], ["d0/y", 0, [["d0/y/p1", 0, []]]]]],
    ]
    assert tell("tree.js", TREE, [driver(0, 1)], []) == [
        ["d0", 0, [["d0/x", 0, [["d0/x/p0", 0, []]]], ["d0/y", 0, []]]]
    ]
    assert tell("tree.js", "[m.OLD, m.GONE]") == [OLD, GONE]


PICTURE = "{ right: 0.4, left: 0.4, top: 0.3, bottom: 0.25 }"
FILLED = f"""(() => {{
    const position = Float32Array.from(a[0].flat()), normal = Float32Array.from(a[1].flat()), n = a[0].length;
    const radius = new Float32Array(n).fill(0.001);
    const sheets = [{{ n, position, normal, radius, placed: a[2] }}], all = () => true, picture = {PICTURE};
    const towards = m.directionOf(sheets, all, picture);
    const {{ position: eye, target }} = m.eyeOf(sheets, all, towards, picture);
    const z = eye.map((x, c) => x - target[c]), away = Math.hypot(...z);
    return [towards, eye, z.map(x => x / away)];
}})()"""


def edges(points: Any, eye: Any, z: Any) -> tuple[float, float, float, float]:
    """How far points are to each side of the picture, of the edge of the picture: right, left, top, bottom."""
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    seen = (np.asarray(points) - eye) @ np.stack([x, np.cross(z, x), z]).T
    across, up = seen[:, 0] / -seen[:, 2], seen[:, 1] / -seen[:, 2]
    return across.max() / 0.4, -across.min() / 0.4, up.max() / 0.3, -up.min() / 0.25


def cylinder(length: float) -> tuple[list[list[float]], list[list[float]]]:
    """Places and normals around an arm along x."""
    at, around = (grid.ravel() for grid in np.meshgrid(np.linspace(0, length, 15), np.arange(12) * np.pi / 6))
    normals = np.stack([0 * around, np.cos(around), np.sin(around)], axis=1)
    return (np.stack([at, 0 * at, 0 * at], axis=1) + 0.03 * normals).tolist(), normals.tolist()


@pytest.mark.parametrize("length", [0.05, 0.3, 0.6])
def test_the_eye_is_as_near_as_all_taxels_can_be_seen(tell: Callable[..., Any], length: float) -> None:
    points, normals = cylinder(length)
    _, eye, z = tell("framing.js", FILLED, points, normals, True)
    sides = edges(points, eye, z)
    assert max(sides) < 1
    assert max(min(sides[:2]), min(sides[2:])) > 0.9  # opposite edges are reached by something


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("steepest", [0.95, 0.2], ids=["nearly flat", "half of an arm"])
def test_an_arm_is_seen_from_the_side_that_has_taxels(tell: Callable[..., Any], side: int, steepest: float) -> None:
    points, normals = cylinder(0.3)
    has = [i for i, normal in enumerate(normals) if side * normal[2] > steepest]
    towards, _, _ = tell("framing.js", FILLED, [points[i] for i in has], [normals[i] for i in has], True)
    assert side * towards[2] > 0.2 * np.linalg.norm(towards)


def test_what_is_laid_out_flat_is_seen_from_above(tell: Callable[..., Any]) -> None:
    points = [[0.01 * i, 0.01 * j, 0.0] for i in range(20) for j in range(4)]
    towards, _, _ = tell("framing.js", FILLED, points, [[0, 0, 1]] * len(points), False)
    assert towards[2] > 0.99 * np.linalg.norm(towards)


def test_no_taxels_and_a_single_one(tell: Callable[..., Any]) -> None:
    assert tell("framing.js", f"m.eyeOf([], () => true, [0, -1, 1], {PICTURE})") is None
    _, eye, _ = tell("framing.js", FILLED, [[1, 2, 3]], [[0, 0, 0]], True)
    assert np.isfinite(eye).all()
    assert np.linalg.norm(np.subtract(eye, [1, 2, 3])) < 0.1


PICK = """m.pick({
    project: (x, y, z) => [x, y, z], pixels: 40, camera: { far: 100, position: { x: 0, y: 0, z: -100 } },
}, [{ n: 4, radius: [5, 5, 5, 5],
      position: [20, 20, 10,  20, 20, 20,  90, 20, 10,  60, 60, 10],
      normal: [0, 0, 1,  0, 0, -1,  0, 0, 0,  0, 0, 1] }], a[0], a[1])?.i ?? null"""


def test_the_taxel_under_the_pointer(tell: Callable[..., Any]) -> None:
    """One that is seen from inside only where there is no other."""
    assert tell("picking.js", PICK, 21, 20) == 1
    assert tell("picking.js", PICK, 95, 20) == 2
    assert tell("picking.js", PICK, 62, 60) == 3
    assert tell("picking.js", PICK, 150, 150) is None


def test_shear_lies_in_the_skin(tell: Callable[..., Any]) -> None:
    normals: list[list[float]] = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0.6, 0, 0.8], [0, 0, 0]]
    for normal in normals:
        first, second = tell("overlay.js", "m.planeOf(a[0])", normal)
        for one in (first, second):
            assert sum(x * x for x in one) == pytest.approx(1)
            assert sum(x * n for x, n in zip(one, normal, strict=True)) == pytest.approx(0)
        assert sum(x * y for x, y in zip(first, second, strict=True)) == pytest.approx(0)


NUMBERED = """(() => {
    const stage = { width: 400, height: 200, pixels: 40, sheets: [] };
    stage.camera = { position: { toArray: () => [0, 0, 9] } };
    stage.project = (x, y) => [x, y, 1];
    const overlay = new m.Overlay(document.body), written = [];
    overlay.context.fillText = (text, x) => written.push([text, Math.round(x)]);
    overlay.draw(stage, { theme: "dark", names: a[1], pins: [], hovered: null, contacts: a[0] });
    return written;
})()"""


def test_the_largest_contacts_have_numbers_and_none_covers_another(tell: Callable[..., Any]) -> None:
    places = [(7, 100, 3), (23, 108, 9), (38, 104, 1), (41, 200, 2), (52, 104, 0.5), (60, 104, 0.4)]
    contacts = [{"id": number, "at": [x, 50, 0], "load": load} for number, x, load in places]
    assert tell("overlay.js", NUMBERED, contacts, []) == [["23", 123], ["7", 85], ["41", 215], ["38", 119], ["52", 89]]
    name = {"text": "palm", "x": 220, "y": 35, "width": 24, "alpha": 1}
    assert tell("overlay.js", NUMBERED, contacts[3:4], [name]) == [["41", 185], ["palm", 220]]
