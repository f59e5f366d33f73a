"""The documentation does what it says: snippets run, and what is named exists."""

from __future__ import annotations

import contextlib
import re
import runpy
import shlex
import signal
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

import skinware
from skinware import realtime, threads
from skinware.conversion.foreign import open_source
from skinware.conversion.foreign.mapping import read_map as read_columns
from skinware.tactile.chain import ChainSettings
from skinware.tactile.curves import read_curves
from skinware.tactile.regions import read_regions
from skinware.tactile.testing import read_stage
from skinware.views.robot import read_robot
from skinware_drivers.cli.driver_setup import ConfigFile
from skinware_drivers.registry import DEFAULT_DRIVER, DRIVERS, load_driver
from skinware_drivers.streams.ros2_map import read_map
from skinware_drivers.virtual.physics.binding import SCENES, find_binding
from tests.cli.fake_skin import FakeSkin, publishing
from tests.commands import COMMANDS, PATIENCE_S, parse, refused, running

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
ELSEWHERE = ("asyncio", "icub")
"""Pages whose snippets other tests run."""
_BLOCK = re.compile(r"^(?:```python|<!-- python)\n(.*?)^(?:```|-->)$", re.MULTILINE | re.DOTALL)


def blocks(page: Path) -> list[tuple[int, str]]:
    """(line, text) of every Python block, also of those in comments, which set the stage for the others."""
    text = page.read_text()
    return [(text.count("\n", 0, match.start(1)), match[1]) for match in _BLOCK.finditer(text)]


def as_program(page: Path) -> str:
    """All blocks of a page, each at the line where it stands, so that errors name the line."""
    lines: list[str] = []
    for line, block in blocks(page):
        lines += [""] * (line - len(lines)) + block.splitlines()
    return "\n".join(lines)


def execute(page: Path) -> subprocess.CompletedProcess[str]:
    """Run a page in a process of its own."""
    compile_and_run = "import sys; path = sys.argv[1]; exec(compile(sys.stdin.read(), path, 'exec'))"
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", compile_and_run, str(page)],
        input=as_program(page),
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=2 * PATIENCE_S,
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    "page", [page for page in PAGES[1:] if blocks(page) and page.stem not in ELSEWHERE], ids=lambda page: page.stem
)
def test_a_page_runs_from_its_first_snippet_to_its_last(page: Path) -> None:
    done = execute(page)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"


def test_a_snippet_that_raises_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("Text\n\n<!-- python\nready = 1\n-->\n\n```python\nassert ready == 1\nassert ready == 2\n```\n")
    done = execute(page)
    assert done.returncode == 1
    assert f'"{page}", line 9' in done.stderr


def test_the_first_reader_of_the_readme_reads(tmp_path: Path) -> None:
    (reader,) = (text for _, text in blocks(ROOT / "README.md") if "skinware.Skin()" in text)
    with running("skin-driver", "--bus", "virtual?boards=7,8"):
        process = subprocess.Popen(
            [sys.executable, "-u", "-W", "error", "-c", reader],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        try:
            lines = [process.stdout.readline() for _ in range(100)]
        finally:
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=PATIENCE_S)
    counts = [re.fullmatch(r"[\d.]+ counts over (\d+) of (\d+) taxels\n", line) for line in lines]
    assert all(counts), f"{lines}\n{errors}"
    assert counts[-1] is not None
    assert int(counts[-1][1]) > 0


def test_the_first_driver_of_the_readme_is_one() -> None:
    (driver,) = (text for _, text in blocks(ROOT / "README.md") if "CanAdapter" in text)
    names: dict[str, object] = {"__name__": "readme"}
    exec(compile(driver, "README.md", "exec"), names)
    adapter: Any = names["Fingertip"]
    assert sum(len(module.channels) for patch in adapter.patches for module in patch.modules) == 12


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_tests_that_are_named_exist(page: Path) -> None:
    text = page.read_text()
    targets = [target for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text) if "://" not in target]
    assert [target for target in targets if not (page.parent / target).exists()] == []
    if page.parent.name == "tutorials":
        return  # files that are named there are those of the reader's own package: see tests/outside/test_tutorials.py
    named = re.findall(r"\b((?:tests|skinware_drivers/testing)/[\w/]+\.py)(?:::(\w+))?", text)
    missing = [
        (file, name)
        for file, name in named
        if not (ROOT / file).exists() or (name and f"def {name}(" not in (ROOT / file).read_text())
    ]
    assert missing == []


@pytest.mark.parametrize("page", ["docs/architecture.md", "CONTRIBUTING.md"])
def test_files_and_folders_that_a_page_names_exist(page: str) -> None:
    named = re.findall(r"`((?:skinware|skinware_drivers|tools|docs|tests)(?:/[\w.]+)*)`", (ROOT / page).read_text())
    assert len(named) >= 2
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_files_that_the_comments_of_c_code_name_exist() -> None:
    modules = "".join(f"/{path}\n" for path in ROOT.rglob("*.py") if ".venv" not in path.parts)
    for source in ROOT.glob("skinware*/native/*.[ch]"):
        named = re.findall(r"[\w/]+\.py\b", source.read_text())
        assert [name for name in named if f"/{name}\n" not in modules] == [], source


def fenced(page: Path, language: str) -> list[str]:
    """The text of every block of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", [page for page in PAGES if fenced(page, "toml")], ids=lambda page: page.stem)
def test_toml_is_what_a_driver_takes(page: Path, tmp_path: Path) -> None:
    """Geometry, stages, chains, curves, regions, links and packages are TOML too; their tables tell."""
    file = tmp_path / "page.toml"
    for text in fenced(page, "toml"):
        found = tomllib.loads(text)
        if found.get("format") == "skinware-stage":
            file.write_text(text)
            read_stage(file)
        elif found.get("format") == "skinware-chain":
            file.write_text(text)
            ChainSettings.read(file)
        elif found.get("format") == "skinware-curves":
            file.write_text(text)
            read_curves(file)
        elif found.get("format") == "skinware-regions":
            file.write_text(text)
            read_regions(file)
        elif found.get("format") == "skinware-binding":
            file.write_text(text.replace('scene = "', f'scene = "{SCENES}/'))
            find_binding(f"mujoco:{file}", "")
        elif found.get("format") == "skinware-columns":
            file.write_text(text)
            tips = {f"f1_{row}_{column}": np.zeros(5) for row in range(3) for column in range(4)}
            arrays = {"time_s": np.arange(5.0), "forces": np.zeros((5, 4, 3)), "places": np.zeros((4, 3)), **tips}
            np.savez(tmp_path / "data.npz", **arrays)  # type: ignore[arg-type]
            with contextlib.closing(open_source(tmp_path / "data.npz")) as source:
                read_columns(file, source)
        elif found.get("format") == "skinware-ros2-map":
            file.write_text(text)
            read_map(str(file))
        elif found.get("format") == "skinware-links":
            file.write_text(text)
            for link in found["link"]:
                (tmp_path / link["mesh"]).touch()
            read_robot(file)
        elif not {"project", "group"} & found.keys():
            file.write_text(re.sub(r"^cpus = .*", "", text, flags=re.MULTILINE))  # that this machine may not have
            read = ConfigFile(file)
            driver = load_driver(read.settings.driver or DEFAULT_DRIVER)
            for bus in read.settings.bus:
                read.options_of_bus(driver.Options, bus.name)


def commands_of(page: Path) -> list[list[str]]:
    """Our commands in the blocks for the terminal, as words."""
    lines = "".join(fenced(page, "console")).replace("\\\n", " ").splitlines()
    simple = [re.split(r" [|>&]( |$)", line)[0].removeprefix("sudo ") for line in lines]
    words = [shlex.split(line, comments=True) for line in simple]
    words = [[word for word in line if not re.match(r"[A-Z_]+=", word)] for line in words]
    return [[Path(line[0]).name, *line[1:]] for line in words if line and Path(line[0]).name in COMMANDS]


def mentioned(page: Path) -> list[list[str]]:
    """Our commands with arguments within the text, as words; without those with gaps or a driver of the reader."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    lines = re.findall(r"`(skin-[a-z]+ [^`\n]+)`", text)
    whole = [shlex.split(line) for line in lines if not re.search(r"\b[A-Z]{3,}\b|\.\.\.|[\[…|]", line)]
    return [words for words in whole if not any(word.endswith(".py") for word in words)]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "page", [page for page in PAGES if commands_of(page) or mentioned(page)], ids=lambda page: page.stem
)
def test_commands_have_the_options_that_a_page_gives_them(page: Path, tmp_path: Path) -> None:
    if page.parent.name == "tutorials" and page.stem.endswith("-driver"):
        return  # of drivers that the page makes: tests/outside/test_tutorials.py runs it all
    file = tmp_path / "any.toml"
    file.touch()
    in_text = mentioned(page) if page.stem != "write-an-emulator" else []  # whose drivers the page makes
    for name, *words in commands_of(page) + in_text:
        arguments = [str(file) if word.endswith(".toml") else word for word in words]
        try:
            parse(name, *arguments)
        except click.UsageError as error:
            is_short = isinstance(error, click.MissingParameter | click.BadOptionUsage)
            if not is_short or [name, *words] not in in_text:  # the text may leave out what follows
                pytest.fail(f"{name} {shlex.join(arguments)}: {error.format_message()}")


CAN_OF_EMULATORS = "udp_multicast:239.74.163.8"


def as_it_can_run_here(name: str, words: list[str]) -> list[str] | None:
    """Arguments that end a command soon and need no hardware; None if there are none.

    ``skin-driver`` checks all that it was given before it prints a unit; emulators are on a bus that each machine has.
    """
    if name == "skin-record":
        return [*words, "-T", "0.1"]
    if any(word.endswith((".toml", ".eds", ".mcap", ".py")) for word in words):
        return None
    if name == "skin-driver":
        return words if "--systemd" in words else [*words, "--systemd"]
    if name == "skin-emulate":
        at = words.index("--bus") + 1
        bus = CAN_OF_EMULATORS if words[at].startswith(("vcan", "udp_multicast")) else words[at].partition("://")[0]
        bus = {"modbus:tcp": "pty", "udp": "udp://127.0.0.1:9", "tcp": "tcp://127.0.0.1:0"}.get(bus, bus)
        bus = {"websocket:ws": "websocket:ws://127.0.0.1:0", "yarp": words[at].replace("10000", "0")}.get(bus, bus)
        bus = "dds://0" if bus == "dds" else bus
        return [*words[:at], "pty" if bus.startswith("pty:") else bus, *words[at + 1 :], "-T", "0"]
    is_short = name == "skin-info" or (name == "skin-dump" and "-n" in words and "--raw" not in words)
    return words if is_short and "--watch" not in words else None


RUN_HERE = [
    (page, name, arguments)
    for page in PAGES
    if not (page.parent.name == "tutorials" and page.stem.endswith("-driver")) and page.stem != "write-an-emulator"
    for name, *words in commands_of(page)
    if (arguments := as_it_can_run_here(name, words)) is not None
]


@pytest.mark.thorough
@pytest.mark.parametrize("page", list(dict.fromkeys(page for page, _, _ in RUN_HERE)), ids=lambda page: page.stem)
def test_documented_commands_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with publishing(FakeSkin("torso")):
        for number, (_, name, arguments) in enumerate(one for one in RUN_HERE if one[0] == page):
            (tmp_path / str(number)).mkdir()
            monkeypatch.chdir(tmp_path / str(number))  # two recordings of one second have one name
            done = refused(name, *arguments)
            assert done.returncode == 0, f"{name} {shlex.join(arguments)}: {done.stderr}"


def test_most_documented_drivers_and_emulators_are_run() -> None:
    names = [name for _, name, _ in RUN_HERE]
    assert names.count("skin-driver") > 70
    assert names.count("skin-emulate") > 20


def test_every_driver_that_ships_is_on_the_list() -> None:
    listed = re.findall(r"^\|.*\| \[`(\w+)`\]", (ROOT / "docs/drivers.md").read_text(), re.MULTILINE)
    ours = [e.name for e in entry_points(group=DRIVERS) if e.value.startswith("skinware_drivers.")]
    assert sorted(listed) == sorted(ours)
    assert f"All {len(ours)} are in [drivers]" in (ROOT / "README.md").read_text()


def test_every_fault_of_the_reference_has_a_test() -> None:
    """That those which are named exist, the test above holds."""
    rows = [line for line in (ROOT / "docs/reference/faults.md").read_text().splitlines() if line.startswith("| ")]
    faults = [row[1:-1].split("|") for row in rows if not row.startswith("| fault |")]
    assert len(faults) > 60
    assert [cells[0].strip() for cells in faults if len(cells) != 4 or "::test_" not in cells[3]] == []


def has(cls: type, name: str) -> bool:
    """Whether objects of a class have an attribute; those that ``__init__`` makes stand in the docstring."""
    return hasattr(cls, name) or bool(re.search(rf"^ +{name}: ", cls.__doc__ or "", re.MULTILINE))


def test_every_capability_of_the_c_library_has_an_answer() -> None:
    text = (ROOT / "docs/reference/skinware2-parity.md").read_text().split("## Failures")[0]
    assert re.findall(r"^### (.+)$", text, re.M) == ["Better", "The same", "Declined"]
    capabilities = set(re.findall(r"^\| (.+) \| .+ \|$", text, re.M)) - {"C library"}
    assert len(capabilities) == 57


def test_attributes_that_the_parity_table_names_exist() -> None:
    text = (ROOT / "docs/reference/skinware2-parity.md").read_text()
    classes = {
        **vars(skinware),
        **{name: getattr(threads, name) for name in ("SkinReplica", "Worker")},
        **{name: getattr(realtime, name) for name in ("Periodic", "Profile")},
    }
    found = {(cls, name) for cls, name in re.findall(r"`(\w+)\.(\w+)", text) if isinstance(classes.get(cls), type)}
    assert len(found) > 20
    assert [f"{cls}.{name}" for cls, name in found if not has(classes[cls], name)] == []
    functions = re.findall(r"`threads\.(\w+)", text)
    assert functions
    assert [name for name in functions if not hasattr(threads, name)] == []


@pytest.mark.thorough
def test_what_is_said_of_an_attribute_is_not_taken_for_its_type() -> None:
    """Sphinx takes the words before the first colon for one: a page of errors had lines such as "Type: It says so"."""
    code = """
import runpy
runpy.run_path("docs/conf.py")
from sphinx.ext import napoleon
text = ["It reports an error: which one, is counted.", "", "Raises:", "    ValueError: never."]
lines = napoleon.GoogleDocstring(text, napoleon.Config(), what="attribute", name="x").lines()
assert lines[0] == text[0], lines
assert ":type:" not in " ".join(lines), lines
assert ":raises ValueError: never." in lines, lines
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize("image", sorted((ROOT / "docs/images").glob("*.svg")), ids=lambda image: image.stem)
def test_pictures_need_nothing_from_elsewhere(image: Path) -> None:
    text = image.read_text()
    assert set(re.findall(r"\w+://[^\"'\s)>]+", text)) <= {"http://www.w3.org/2000/svg"}
    assert "@font-face" not in text
    assert "@import" not in text
    assert image.stat().st_size < 100_000


def test_pages_that_messages_name_exist() -> None:
    """By their titles: who has installed a wheel has no files of the documentation."""
    titles = {page.read_text().partition("\n")[0].removeprefix("# ") for page in (ROOT / "docs").rglob("*.md")}
    code = "".join(
        path.read_text() for folder in ("skinware", "skinware_drivers") for path in (ROOT / folder).rglob("*.py")
    )
    named = set(re.findall(r'see "([^"]+)" in the documentation', code))
    assert len(named) >= 2
    assert named <= titles
    assert not re.findall(r"see docs/[\w/-]+\.md", code)


def test_the_picture_of_the_benchmarks_shows_the_figures_of_the_page() -> None:
    script = ROOT / "tools" / "pictures" / "benchmarks.py"
    made = runpy.run_path(str(script))
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    table = "\n".join(line for line in page.splitlines() if not line.startswith("* "))
    for bars in made["GROUPS"].values():
        for bar in bars:
            assert re.search(rf"(?<![\d.,]){re.escape(bar.text)}(?![\d,]|\.\d)", table), (
                f"{bar.text} of {bar.who} is not on the page"
            )
    shown = (ROOT / "docs" / "images" / "benchmarks.svg").read_text(encoding="utf-8")
    assert shown == made["picture"](), "run tools/pictures/benchmarks.py docs/images/benchmarks.svg"
