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
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SEEDS, CACHE = ROOT / "tests" / "serial" / "seeds", ROOT / ".cache" / "fuzz"
MOST_KEPT, LONGEST_KEPT = 16, 400
sys.path.insert(0, str(ROOT))


def fuzz_one(name: str, arguments: list[str]) -> None:
    """Fuzz one framing in this process; does not come back."""
    import atheris

    with atheris.instrument_imports(include=["skinware_drivers.serial"]):
        from tests.serial.fuzzing import known_examples, run
    example = known_examples()[name]

    def one(data: bytes) -> None:
        run(example, data)

    atheris.Setup([f"fuzz {name}", *arguments], one)
    atheris.Fuzz()


def libfuzzer(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run this program on one framing."""
    command = [sys.executable, __file__, "--one", name, *arguments]
    return subprocess.run(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)


def corpus_of(name: str, seed: int | None) -> Path:
    """Where the inputs for a framing are kept."""
    return CACHE / (name if seed is None else f"{name}.seed-{seed}")


def fuzz(name: str, seconds: float, seed: int | None) -> bool:
    """Fuzz one framing for a time; tells whether it held."""
    corpus = corpus_of(name, seed)
    if seed is not None:
        shutil.rmtree(corpus, ignore_errors=True)  # what earlier runs found would lead elsewhere
    corpus.mkdir(parents=True, exist_ok=True)
    seeds = SEEDS / f"{name}.hex"
    for number, line in enumerate(seeds.read_text().split() if seeds.exists() else []):
        (corpus / f"seed-{number:03}").write_bytes(bytes.fromhex(line))
    done = libfuzzer(
        name,
        f"-max_total_time={max(1, round(seconds))}",
        "-rss_limit_mb=1024",
        "-timeout=10",
        "-max_len=600",
        "-len_control=20",
        "-print_final_stats=1",
        f"-seed={seed or 0}",  # 0: another each time
        f"-artifact_prefix={CACHE}/{name}.",
        str(corpus),
    )
    lines = done.stdout.splitlines()
    figures = dict(line[6:].split(": ") for line in lines if line.startswith("stat::"))
    runs, memory = figures.get("number_of_executed_units", "?"), figures.get("peak_rss_mb", "?")
    inputs = sum(1 for _ in corpus.iterdir())
    held = done.returncode == 0
    print(
        f"{name:18} {'held' if held else 'BROKEN':7} {runs:>8} runs  {inputs:4} inputs  {memory.strip():>4} MB",
        flush=True,
    )
    if not held:
        print("\n".join(lines[-60:]))
    return held


def keep(name: str, seed: int | None) -> None:
    """Write some of the inputs that reached something new, small and large ones, as seeds."""
    inputs = sorted((path.read_bytes() for path in corpus_of(name, seed).iterdir()), key=len)
    kept = [data.hex() for data in inputs if 0 < len(data) <= LONGEST_KEPT]
    spread = kept[:: max(1, -(-len(kept) // MOST_KEPT))]
    SEEDS.mkdir(exist_ok=True)
    (SEEDS / f"{name}.hex").write_text("".join(f"{line}\n" for line in spread))


def main() -> None:
    """Entry point."""
    if sys.argv[1:2] == ["--one"]:
        fuzz_one(sys.argv[2], sys.argv[3:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="framings; default: all")
    parser.add_argument("--seconds", type=float, default=60, help="of fuzzing, for all of them together")
    parser.add_argument("--seed", type=int, metavar="N", help="the same inputs each time, from 1 on")
    parser.add_argument("--keep", action="store_true", help="write the inputs worth keeping as seeds")
    arguments = parser.parse_args()
    from tests.serial.fuzzing import known_examples

    known = list(known_examples())
    names = arguments.names or known
    if unknown := sorted(set(names) - set(known)):
        parser.error(f"no framing {', '.join(unknown)}; there are: {', '.join(known)}")
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # they wait for processes
        held = list(pool.map(lambda name: fuzz(name, arguments.seconds / len(names), arguments.seed), names))
    if arguments.keep:
        for name in names:
            keep(name, arguments.seed)
    sys.exit(not all(held))


if __name__ == "__main__":
    main()
