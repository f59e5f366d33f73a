"""What the tools do to the machine that they run on: packages are installed as root, behind any other apt, or named;
the environment is made anew when what is in it has changed."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

TOOLS = Path(__file__).parent.parent / "tools"
PACKAGES = TOOLS / "_packages.sh"


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in front of PATH: an ``apt-get`` that notes what it is asked for, run by root, and no pauses."""
    put(tmp_path / "apt-get", 'echo "$@" >>"$(dirname "$0")/asked"')
    put(tmp_path / "id", "echo 0")
    put(tmp_path / "sleep", "")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path


def put(path: Path, script: str) -> None:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


def shell(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-uc", f"source {PACKAGES}; {script}"], capture_output=True, text=True)


def asked(fake: Path) -> list[str]:
    return (fake / "asked").read_text().splitlines() if (fake / "asked").exists() else []


def test_root_installs_and_says_what_for_in_one_line(fake: Path) -> None:
    done = shell('install_packages "to see" one two && install_packages "to hear" three')
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.splitlines() == ["installing one two (to see)", "installing three (to hear)"]
    install = "-qq install --yes --no-install-recommends"
    assert asked(fake) == ["-qq update", f"{install} one two", f"{install} three"]


@pytest.mark.parametrize("message", ["Could not get lock /var/lib/apt/lists/lock", "Unable to lock directory"])
def test_another_apt_is_waited_for(fake: Path, message: str) -> None:
    count = f'n=$(cat {fake}/count 2>/dev/null); echo "$n+" >{fake}/count; [ "$n" = "+++" ]'
    put(fake / "apt-get", f'{count} || {{ echo "E: {message}" >&2; exit 100; }}')
    done = shell("apt_get update")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == "another apt is running: waiting for it, at most 10 minutes\n"
    assert (fake / "count").read_text() == "++++\n"


def test_another_apt_is_not_waited_for_indefinitely(fake: Path) -> None:
    put(fake / "apt-get", 'echo "E: Could not get lock" >&2; exit 100')
    done = shell("lock_wait_s=1; apt_get update")
    assert done.returncode == 1
    assert done.stderr.endswith("E: Could not get lock\n")


def test_what_apt_says_is_shown_if_it_fails(fake: Path) -> None:
    put(fake / "apt-get", 'echo "E: Unable to locate package two" >&2; exit 100')
    done = shell('install_packages "to see" one two')
    assert done.returncode == 1
    assert done.stderr == "installing one two (to see)\nE: Unable to locate package two\n"


@pytest.mark.parametrize(("user", "may_install"), [("1000", "yes"), ("0", "no")])
def test_who_may_not_install_is_told_the_line_to_type(fake: Path, user: str, may_install: str) -> None:
    put(fake / "id", f"echo {user}")
    done = shell(f'may_install={may_install}; install_packages "to see" one two')
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "missing to see; on Debian and Ubuntu:",
        "    sudo apt-get update && sudo apt-get install --no-install-recommends one two",
    ]
    assert asked(fake) == []


# -- the environment ----------------------------------------------------------------------------------------------


INSTALLED = [
    "pyproject.toml",
    "setup.py",
    "skinware/native/ring.c",
    "skinware/native/ring.h",
    "skinware/include/skinware.h",
]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """One with a tool, something to compile, and an environment whose Python notes what it is asked for."""
    project = tmp_path / "a project"
    for folder in ("skinware/native", "skinware/include", "tools", ".venv/bin"):
        (project / folder).mkdir(parents=True)
    shutil.copy(TOOLS / "_environment.sh", project / "tools")
    for file in INSTALLED:
        (project / file).write_text("as it was")
    put(project / ".venv/bin/python", f'echo "$@" >>"{project}/asked"')
    return project


@pytest.fixture
def compiling(project: Path) -> Path:
    """Such a project where installing it compiles: its library."""
    library = project / "skinware/native/libskinware.so"
    put(
        project / ".venv/bin/python",
        f'echo "$@" >>"{project}/asked"; case "$*" in *"pip install"*) touch "{library}" ;; esac',
    )
    return library


def prepare(project: Path, compiler: str, extra: str = "test") -> subprocess.CompletedProcess[str]:
    script = f'source "{project}/tools/_environment.sh"; prepare_environment {extra}'
    environment = {**os.environ, "CC": compiler}
    return subprocess.run(["bash", "-euc", script], env=environment, check=True, capture_output=True, text=True)


def installs(project: Path, compiler: str = "true", extra: str = "test") -> bool:
    """Whether the environment was installed anew."""
    asked = project / "asked"
    asked.unlink(missing_ok=True)
    prepare(project, compiler, extra)
    return "-m pip install" in asked.read_text()


@pytest.mark.parametrize("changed", INSTALLED)
def test_what_has_changed_is_installed_again(project: Path, changed: str) -> None:
    assert installs(project)
    assert not installs(project)
    (project / changed).write_text("new")
    assert installs(project)
    assert not installs(project)


@pytest.mark.parametrize("extra", ["test", "top"])
def test_a_library_that_was_cleaned_away_is_compiled_again(project: Path, compiling: Path, extra: str) -> None:
    assert installs(project)
    assert not installs(project)
    assert installs(project, extra="top")  # which compiles too, and leaves nothing to do for the other
    assert not installs(project)
    compiling.unlink()
    assert installs(project, extra=extra)
    assert compiling.exists()
    assert not installs(project, extra=extra)


@pytest.mark.parametrize("source", ["skinware/native/ring.c", "skinware/include/skinware.h"])
def test_a_library_older_than_its_sources_is_compiled_again(project: Path, compiling: Path, source: str) -> None:
    """As after a checkout that was compiled for other sources meanwhile: the sources alone are what they were."""
    assert installs(project)
    earlier_s = (project / source).stat().st_mtime - 10
    os.utime(compiling, (earlier_s, earlier_s))
    assert installs(project)
    assert not installs(project)


@pytest.mark.thorough
def test_the_figures_of_the_house_may_be_cut_short() -> None:
    done = subprocess.run(["bash", "-c", f"{TOOLS}/house | true"], capture_output=True, text=True)
    assert done.stderr == ""
