"""An extra installs all that its command needs: packages of others are hidden from it."""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.commands import COMMANDS, running

SCRIPT = """#!{python}
import sys
from importlib import import_module
from importlib.machinery import PathFinder

HIDDEN = {hidden}


class Installed(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in HIDDEN else PathFinder.find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Installed
sys.exit(import_module("{module}").main())
"""


def installed_with(extras: frozenset[str]) -> set[str]:
    """Return the names of the distributions that ``pip install 'skinware[EXTRAS]'`` installs."""
    found, wanted = {"skinware"}, [("skinware", extras)]
    while wanted:
        name, extras = wanted.pop()
        try:
            lines = requires(name) or []
        except PackageNotFoundError:  # not for this machine
            continue
        for one in map(Requirement, lines):
            if one.marker is None or any(one.marker.evaluate({"extra": extra}) for extra in extras | {""}):
                if (key := canonicalize_name(one.name)) not in found or one.extras:
                    wanted.append((key, frozenset(one.extras)))
                found.add(key)
    return found


@pytest.mark.parametrize(
    ("extra", "command", "arguments"),
    [
        ("view", "skin-view", ["--no-browser", "--port", "0"]),
        ("record", "skin-record", ["walk.mcap"]),
        ("mujoco", "skin-driver", ["--driver", "inspire", "--bus", "virtual?world=mujoco:hand"]),
    ],
)
def test_what_an_extra_installs_is_enough(
    extra: str, command: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    there = installed_with(frozenset({extra}))
    hidden = {
        package
        for package, distributions in packages_distributions().items()
        if there.isdisjoint(map(canonicalize_name, distributions))
    }
    assert {"pytest", "hypothesis"} <= hidden
    script = tmp_path / command
    script.write_text(SCRIPT.format(python=sys.executable, hidden=hidden, module=COMMANDS[command]))
    script.chmod(0o755)
    with running(str(script), *arguments) as started:
        started.wait_for("ready")
