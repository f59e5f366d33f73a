"""Fuzzing of the framers, guided by coverage: ``tools/fuzz [NAME ...] [--seconds 60] [--seed N] [--keep]``.

Every framing of the tests and of the installed drivers gets an equal part of the time, in a process of its own, with
at most 1 GiB of memory and 10 s for an input. It begins with the seeds in tests/serial/seeds and with what earlier
runs left in .cache/fuzz. What it breaks is written to .cache/fuzz/NAME.crash-*, and belongs into the seeds once
the cause is removed: ``--keep`` writes some of what reached anything new there. The tests run the seeds, and changes of
them that are always the same; here everything is different each time, unless ``--seed`` is given: a failure of
``tools/test fuzz`` comes again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parents[2]
SEEDS, CACHE = ROOT / "tests" / "serial" / "seeds", ROOT / ".cache" / "fuzz"
MOST_KEPT, LONGEST_KEPT = 16, 400
sys.path.insert(0, str(ROOT))


def instrumented() -> dict[str, Callable[[bytes], None]]:
    """What runs an input, by name of its framing; imported so that the fuzzer sees the ways through the framers."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # what forks has one thread
    import atheris

    with contextlib.redirect_stderr(io.StringIO()):  # a line for every module
        with atheris.instrument_imports(include=["skinware_drivers.serial", "tests.specification.framers"]):
            from tests.serial.fuzzing import known_examples, run
    return {name: partial(run, example) for name, example in known_examples().items()}


def corpus_of(name: str, seed: int | None) -> Path:
    """Where the inputs for a framing are kept."""
    return CACHE / (name if seed is None else f"{name}.seed-{seed}")


def log_of(name: str) -> Path:
    """What the fuzzer said of a framing the last time."""
    return CACHE / f"{name}.log"


def fuzz_one(name: str, one: Callable[[bytes], None], seconds: float, seed: int | None) -> NoReturn:
    """Fuzz one framing for a time, and end this process; what is said of it goes into its log."""
    import atheris

    with log_of(name).open("wb") as log:
        os.dup2(log.fileno(), sys.stdout.fileno())
        os.dup2(log.fileno(), sys.stderr.fileno())
    corpus = corpus_of(name, seed)
    if seed is not None:
        shutil.rmtree(corpus, ignore_errors=True)  # what earlier runs found would lead elsewhere
    corpus.mkdir(parents=True, exist_ok=True)
    seeds = SEEDS / f"{name}.hex"
    for number, line in enumerate(seeds.read_text().split() if seeds.exists() else []):
        (corpus / f"seed-{number:03}").write_bytes(bytes.fromhex(line))
    options = [
        f"-max_total_time={max(1, round(seconds))}",
        "-rss_limit_mb=1024",
        "-timeout=10",
        "-max_len=600",
        "-len_control=20",
        "-print_final_stats=1",
        f"-seed={seed or 0}",  # 0: another each time
        f"-artifact_prefix={CACHE}/{name}.",
    ]
    atheris.Setup([sys.argv[0], *options, str(corpus)], one)
    atheris.Fuzz()
    sys.exit("the fuzzer came back")


def tell(name: str, seed: int | None, held: bool) -> None:
    """A line for one framing, and the end of its log if it broke."""
    lines = log_of(name).read_text(errors="replace").splitlines()
    figures = dict(line[6:].split(": ") for line in lines if line.startswith("stat::"))
    runs, memory = figures.get("number_of_executed_units", "?"), figures.get("peak_rss_mb", "?")
    inputs = sum(1 for _ in corpus_of(name, seed).iterdir())
    print(
        f"{name:18} {'held' if held else 'BROKEN':7} {runs:>8} runs  {inputs:4} inputs  {memory.strip():>4} MB",
        flush=True,
    )
    if not held:
        print("\n".join(lines[-60:]), flush=True)


def fuzz_all(ones: dict[str, Callable[[bytes], None]], seconds: float, seed: int | None) -> bool:
    """Fuzz framings for a time that they share, as many at once as there are processors; whether all held."""
    CACHE.mkdir(parents=True, exist_ok=True)
    waiting, running, all_held = list(ones), dict[int, str](), True
    while waiting or running:
        if waiting and len(running) < (os.cpu_count() or 1):
            name = waiting.pop(0)
            if (process := os.fork()) == 0:  # it has imported everything
                fuzz_one(name, ones[name], seconds / len(ones), seed)
            running[process] = name
        else:
            process, status = os.wait()
            tell(running.pop(process), seed, held=status == 0)
            all_held &= status == 0
    return all_held


def keep(name: str, seed: int | None) -> None:
    """Write some of the inputs that reached something new, small and large ones, as seeds."""
    inputs = sorted((path.read_bytes() for path in corpus_of(name, seed).iterdir()), key=len)
    kept = [data.hex() for data in inputs if 0 < len(data) <= LONGEST_KEPT]
    spread = kept[:: max(1, -(-len(kept) // MOST_KEPT))]
    SEEDS.mkdir(exist_ok=True)
    (SEEDS / f"{name}.hex").write_text("".join(f"{line}\n" for line in spread))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="framings; default: all")
    parser.add_argument("--seconds", type=float, default=60, help="of fuzzing, for all of them together")
    parser.add_argument("--seed", type=int, metavar="N", help="the same inputs each time, from 1 on")
    parser.add_argument("--keep", action="store_true", help="write the inputs worth keeping as seeds")
    arguments = parser.parse_args()
    known = instrumented()
    names = arguments.names or list(known)
    if unknown := sorted(set(names) - set(known)):
        parser.error(f"no framing {', '.join(unknown)}; there are: {', '.join(known)}")
    all_held = fuzz_all({name: known[name] for name in names}, arguments.seconds, arguments.seed)
    if arguments.keep:
        for name in names:
            keep(name, arguments.seed)
    sys.exit(not all_held)


if __name__ == "__main__":
    main()
