"""Fuzzing of the data path in C beside that of numpy, guided by coverage: ``data_path.py [--seconds 20] [--seed N]``.

C is compiled with sanitizers: a byte read or written beside its buffers ends the run, as does everything in which the
two paths differ. An input is a script (tests/native/fuzzing.py); those that reach a new place in C are changed further.
The one that broke it is in .cache/fuzz/data_path.crash, and ``--input FILE`` runs it once more.
"""

from __future__ import annotations

import argparse
import ctypes
import logging
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
CRASH = ROOT / ".cache" / "fuzz" / "data_path.crash"
LONGEST = 3000
FIRST = 30
"""Random inputs to begin with."""
PATIENCE_S = 120
sys.path.insert(0, str(ROOT))

from skinware.memory.namespace import Namespace  # noqa: E402
from tests.native import sanitizing  # noqa: E402


def fuzz(seconds: float, rng: random.Random) -> None:
    """Fuzz in this process, which the sanitizers end if C does what it must not."""
    from skinware_drivers import native
    from tests.native.fuzzing import run
    from tests.serial.fuzzing import changed
    from tests.specification.both_paths import hand_clock

    sanitizing.use_library()
    library = native.library()
    reached = np.ctypeslib.as_array((ctypes.c_uint8 * (1 << 16)).in_dll(library.quick, "reached"))
    logging.getLogger("skinware").addHandler(logging.NullHandler())
    corpus, places, runs, frames = list[bytes](), 0, 0, 0
    end_s = time.monotonic() + seconds
    with hand_clock() as clock:
        while time.monotonic() < end_s:
            data = rng.randbytes(rng.randint(1, LONGEST)) if runs < FIRST else changed(corpus, rng, LONGEST)
            CRASH.write_bytes(data)
            frames += run(clock, data)
            runs += 1
            if np.count_nonzero(reached) > places:
                places = int(np.count_nonzero(reached))
                corpus.append(data)
    print(f"held: {runs} runs, {frames} frames published, {len(corpus)} inputs that reached new places, of {places}")
    CRASH.unlink()


def run_once(data: bytes) -> None:
    """Run one input in this process."""
    from tests.native.fuzzing import run
    from tests.specification.both_paths import hand_clock

    sanitizing.use_library()
    with hand_clock() as clock:
        print(f"held: {run(clock, data)} frames published")


def main() -> int:
    """Entry point: compiles, and calls itself with the sanitizers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20, help="of fuzzing")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 1_000_000)
    parser.add_argument("--input", type=Path, metavar="FILE", help="run this input, and nothing else")
    given = parser.parse_args()
    if sanitizing.LIBRARY in os.environ:
        if given.input:
            run_once(given.input.read_bytes())
        else:
            fuzz(given.seconds, random.Random(given.seed))
        return 0
    if shutil.which(sanitizing.COMPILER) is None:
        print(f"no {sanitizing.COMPILER} here: nothing was fuzzed")
        return 1
    CRASH.parent.mkdir(parents=True, exist_ok=True)
    os.environ["SKINWARE_NAMESPACE"] = f"fuzz-{os.getpid()}"
    try:
        with tempfile.TemporaryDirectory(prefix="skinware-fuzz-") as folder:
            environment = sanitizing.environment(sanitizing.compile_sanitized(Path(folder)))
            command = [sys.executable, __file__, *sys.argv[1:], "--seed", str(given.seed)]
            status = subprocess.run(
                command, env=environment, timeout=given.seconds + PATIENCE_S, check=False
            ).returncode
    finally:
        shutil.rmtree(Namespace().path, ignore_errors=True)
    if status and not given.input:
        print(f"BROKEN (seed {given.seed}): {CRASH}")
    return int(status != 0)


if __name__ == "__main__":
    sys.exit(main())
