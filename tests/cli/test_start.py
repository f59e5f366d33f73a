"""Commands before their modules are imported: Ctrl-C, and streams that are closed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

_INTERRUPT = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"


@pytest.mark.parametrize(
    ("module", "status", "printed"),
    [
        (f"{_INTERRUPT}\n", 130, ""),
        ("def main():\n    print('runs')\n", 0, "runs\n"),
        (
            f"def main():\n    try:\n        {_INTERRUPT}\n    except KeyboardInterrupt:\n        print('noticed')\n",
            0,
            "noticed\n",
        ),
    ],
    ids=["during the import", "never", "after the import"],
)
def test_ctrl_c_before_a_command_runs_ends_it_in_silence(
    module: str, status: int, printed: str, tmp_path: Path
) -> None:
    (tmp_path / "interrupted.py").write_text(module)
    program = "import skinware_start; skinware_start._Function('interrupted.main')()"
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (status, printed, "")


def test_closed_streams_lead_nowhere_and_keep_their_descriptors(tmp_path: Path) -> None:
    check = "print(sys.stdin.read(), sys.stdout.isatty(), file=sys.stderr); sys.exit(open('other', 'w').fileno() < 3)"
    (tmp_path / "closed.py").write_text(f"import sys\ndef main():\n    {check}\n")
    program = "import skinware_start; skinware_start._Function('closed.main')()"
    closing = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh"]
    assert subprocess.run([*closing, sys.executable, "-c", program], cwd=tmp_path, check=False).returncode == 0


def test_an_interrupt_that_a_destructor_drops_comes_again() -> None:
    program = """
import os, signal, time
import click
from skinware.cli import _command as cli

class Dropping:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)

@click.command("skin-try")
def command():
    Dropping()
    click.echo("goes on", nl=True)
    time.sleep(60)

cli.run(command)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=30)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "goes on\n", "")
