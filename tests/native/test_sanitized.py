"""The data path in C under sanitizers: no byte beside its buffers, nothing undefined, whatever comes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from skinware.memory.namespace import Namespace
from tests.native import sanitizing
from tests.sharing import made_once

pytestmark = [pytest.mark.timeout(300)]
ROOT = Path(__file__).parents[2]
BESIDE = """
from tests.native import sanitizing
sanitizing.use_library()
from tests.native.fuzzing import designs
from tests.specification.both_paths import Pair, hand_clock

design = designs()["headers"]
with hand_clock() as clock, Pair(clock, design.layouts, design.tables(), design.periods_s, rows=8) as pair:
    batch = pair.native.batch
    pair.native.empty()
    batch.stop = batch.capacity + 1
    print("so far", flush=True)
    pair.native.digest(())
print("not found")
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def make(folder: Path) -> None:
        sanitizing.compile_sanitized(folder)

    return made_once(tmp_path_factory, "sanitized-data-path", make) / "libskinware_drivers.so"


def run(library: Path, *arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
    environment = {**sanitizing.environment(library), "PYTHONPATH": str(ROOT), **more}
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT, timeout=280)


@pytest.mark.thorough
def test_what_lies_beside_the_buffers_is_found(library: Path, namespace: Namespace) -> None:
    """Else the other tests here would prove nothing."""
    done = run(library, "-c", BESIDE)
    for left in namespace.path.glob("*.ring"):  # the process ended where it was
        left.unlink()
    assert done.returncode != 0
    assert done.stdout == "so far\n"
    assert "AddressSanitizer: heap-buffer-overflow" in done.stderr


@pytest.mark.thorough
def test_both_paths(library: Path) -> None:
    """The tests of both paths, fewer of each."""
    tests = str(Path(__file__).with_name("test_both_paths.py"))
    arguments = ["-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "--hypothesis-seed=1", tests]
    done = run(library, *arguments, SKINWARE_EXAMPLES="25")
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert re.search(r"^\d+ passed in", done.stdout, re.MULTILINE)  # and none skipped


@pytest.mark.thorough
def test_bytes_at_random() -> None:
    """A little of what ``tools/test fuzz`` does for longer."""
    command = [sys.executable, "tools/fuzzing/data_path.py", "--seconds", "5", "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ), cwd=ROOT, timeout=200)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert re.search(r"^held: \d+ runs", done.stdout, re.MULTILINE)
