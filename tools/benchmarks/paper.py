"""The experiment of section 4 of the Skinware 2.0 article, with the C library's figures beside it.

30,848 sensors over 1 to 8 virtual drivers with 2 to 8 buffers, read by 1 to 15 user applications; writers at a random
30 to 50 Hz, periodic readers at a random 10 to 100 Hz. Results go into a folder: results.csv (a row per trial; an
interrupted run goes on where it was), and figures 3 to 5 of the article as PNG.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import random
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path

from paper_faults import measure_faults
from paper_figures import draw
from paper_run import COLUMNS, Trial, has_compiler, measure, row
from processes import RunFailed, own_namespace

from skinware import Namespace

_ATTEMPTS = 3
_FAULT_ROUNDS, _QUICK_FAULT_ROUNDS = 10, 3
_OVERHEAD_S = 1.2  # what a trial takes beyond its measured time, before there is experience

# The C library (tag v2.0.0) on a machine of this kind, one run of 11 s each, as it counts: drivers, buffers, users,
# readers; us: mean CPU of a reader's turn, worst; mean CPU of a writer's turn, worst; mean age, worst reader's p99 age.
C_LIBRARY = (
    (1, 4, 1, "asap", 65.2, 148, 14.6, 59, 30, 100),
    (4, 4, 8, "asap", 40.5, 838, 24.3, 328, 100, 500),
    (8, 8, 15, "asap", 32.9, 264, 34.5, 128, 150, 500),
    (1, 4, 1, "periodic", 47.9, 118, 14.8, 73, 1890, 2100),
    (4, 4, 8, "periodic", 18.4, 133, 10.6, 65, 9800, 29_100),
    (1, 4, 15, "periodic", 59.9, 1191, 16.3, 194, 11_830, 29_500),
    (8, 8, 15, "periodic", 8.9, 296, 6.3, 44, 12_970, 33_000),
)


def grid(drivers: Iterable[int], buffers: Iterable[int], users: Iterable[int], repetitions: int) -> list[Trial]:
    """All combinations, each repetition in an order of its own, so that a part of them is a fair sample."""
    combinations = list(product(drivers, buffers, users))
    trials = []
    for repetition in range(repetitions):
        order = random.Random(repetition).sample(combinations, len(combinations))
        trials += [Trial(repetition, *combination) for combination in order]
    return trials


def beside_the_c_library(repetitions: int) -> list[Trial]:
    """The configurations with figures of the C library; the same read as one skin, and by programs in C."""
    configurations = dict.fromkeys(line[:4] for line in C_LIBRARY)
    for mode in ("skin", "c asap", "c skin") if has_compiler() else ("skin",):
        configurations |= dict.fromkeys((*line[:3], mode) for line in C_LIBRARY if line[3] == "asap")
    return [Trial(repetition, *one) for repetition in range(repetitions) for one in configurations]


def load(path: Path) -> list[dict[str, str]]:
    """Rows of a results file, none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def run(
    trials: Sequence[Trial],
    path: Path,
    seconds: float,
    namespace: Namespace,
    *,
    fifo: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Run the trials that the file has not yet, each written at once.

    Raises:
        RunFailed: a trial failed several times in a row.
        ValueError: the file was made with trials of another length.
    """
    rows = load(path)
    other = {float(one["seconds"]) for one in rows} - {seconds}
    if other:
        raise ValueError(f"{path} has trials of {max(other):g} s, not {seconds:g} s; give another --output")
    done = {tuple(one[name] for name in Trial.__dataclass_fields__) for one in rows}
    to_do = [trial for trial in dict.fromkeys(trials) if tuple(map(str, vars(trial).values())) not in done]
    begin, each_s = time.monotonic(), seconds + _OVERHEAD_S
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not rows:
            writer.writeheader()
        for number, trial in enumerate(to_do):
            if number:
                each_s = (time.monotonic() - begin) / number
            left = time.strftime("%H:%M:%S", time.gmtime(each_s * (len(to_do) - number) % 86_400))
            days = int(each_s * (len(to_do) - number) // 86_400)
            say(f"{len(rows) + number + 1} of {len(rows) + len(to_do)}, {f'{days} d ' if days else ''}{left} left")
            for attempt in range(1, _ATTEMPTS + 1):
                try:
                    figures = measure(trial, namespace, seconds, fifo=fifo)
                    break
                except RunFailed as error:
                    if attempt == _ATTEMPTS:
                        raise
                    say(f"{trial}: {error}; again")
            writer.writerow(row(trial, figures))
            file.flush()


def _median(rows: Sequence[Mapping[str, str]], what: str) -> float:
    return statistics.median(float(one[what]) for one in rows)


def effects(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Figures 3 to 5 as a table: over all periodic trials with so many drivers, users or buffers."""
    lines = [
        "| | trials | writer worst µs | writer mean µs | reader worst µs | reader mean µs | torn | missed periods |",
        "|" + "---|" * 8,
    ]
    periodic = [one for one in rows if one["readers"] == "periodic"]
    for what in ("drivers", "users", "buffers"):
        for count in sorted({int(one[what]) for one in periodic}):
            these = [one for one in periodic if int(one[what]) == count]
            fields = [f"{count} {what}", f"{len(these)}"]
            fields += [
                f"{_median(these, f'{who}_{figure}_us'):.0f}"
                for who in ("writer", "reader")
                for figure in ("worst", "mean")
            ]
            fields += [f"{sum(int(one[column]) for one in these)}" for column in ("torn", "missed_periods")]
            lines.append(f"| {' | '.join(fields)} |")
    return lines


def comparison(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Ours / the C library's, medians over the repetitions; rows of skins and of programs in C have no counterpart."""
    titles = (
        "drivers, buffers, users, readers",
        "reader CPU µs a turn, mean / C",
        "worst / C",
        "CPU µs a whole skin / C",
        "writer CPU µs, mean / C",
        "age µs, mean / C",
        "worst reader's p99 age µs / C",
    )
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    for trial in beside_the_c_library(1):
        key = (trial.drivers, trial.buffers, trial.users, trial.readers)
        these = [
            one for one in rows if (int(one["drivers"]), int(one["buffers"]), int(one["users"]), one["readers"]) == key
        ]
        if not these:
            continue
        theirs = next((line[4:] for line in C_LIBRARY if line[:4] == key), None)
        names = ("reader_mean", "reader_worst", "skin_cpu", "writer_mean", "age_mean", "age_p99")
        fields = [f"{_median(these, f'{name}_us'):.0f}" for name in names]
        if theirs is not None:
            mean, worst, writer_mean, _, age, age_p99 = theirs
            others = (mean, worst, mean * trial.drivers, writer_mean, age, age_p99)
            fields = [f"{field} / {other:.0f}" for field, other in zip(fields, others, strict=True)]
        lines.append(f"| {', '.join(map(str, key))} | {' | '.join(fields)} |")
    return lines


def verdicts(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """What became of the targets for ASAP readers, in words."""
    lines = []
    for drivers, buffers, users, mode, mean, _, _, _, age, _ in C_LIBRARY:
        these = [one for one in rows if _key(one) == (str(drivers), str(buffers), str(users), mode)]
        if mode != "asap" or not these:
            continue
        for title, ours, theirs in (
            ("mean age", _median(these, "age_mean_us"), float(age)),
            ("CPU of a whole skin", _median(these, "skin_cpu_us"), mean * drivers),
        ):
            word = "met   " if ours <= theirs else "MISSED"
            lines.append(f"{word} {title}, {drivers} drivers, {users} users: {ours:.0f} us, C library {theirs:.0f} us")
    return lines


def looks(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """What a look at all sensors costs where the C library was measured with ASAP readers; the largest skin comes last.

    A program in C with a thread for each driver does what the C library's readers do, on the same machine at the same
    time: where it takes longer or shorter than theirs, the machine is another, and the target moves with it.
    """
    lines = []
    for drivers, buffers, users, _, mean, *_ in sorted(line for line in C_LIBRARY if line[3] == "asap"):
        cpu_us = {}
        for readers in ("skin", "c skin", "c asap"):
            key = (str(drivers), str(buffers), str(users), readers)
            these = [one for one in rows if _key(one) == key]
            cpu_us[readers] = [float(one["skin_cpu_us"]) for one in these]
        if not all(cpu_us.values()):
            continue
        ours, c_skin, c_asap = (statistics.median(times) for times in cpu_us.values())
        ratio = statistics.median(a / b for a, b in zip(cpu_us["skin"], cpu_us["c skin"], strict=True))
        lines.append(
            f"a look at {drivers} drivers, {users} users: {ours:.0f} us, C program {c_skin:.0f} us, ratio {ratio:.1f};"
            f" a thread a driver in C {c_asap:.0f} us, C library {mean * drivers:.0f} us"
        )
    return lines


def _key(one: Mapping[str, str]) -> tuple[str, str, str, str]:
    return one["drivers"], one["buffers"], one["users"], one["readers"]


def _say(text: str) -> None:
    print(f"\r{text:78}", end="", file=sys.stderr, flush=True)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--full", action="store_true", help="the article's 3360 trials of 60 s (58 hours)")
    size.add_argument("--quick", action="store_true", help="about 2 minutes")
    size.add_argument("--compared", action="store_true", help="only what is compared with C, without kills; 3 minutes")
    parser.add_argument("--seconds", type=float, help="measured time of each trial (default: 60, 2 or 5)")
    parser.add_argument("--output", type=Path, help="folder of the results (default: build/paper-...)")
    parser.add_argument("--fifo", action="store_true", help="SCHED_FIFO: writers 50, readers 40")
    arguments = parser.parse_args()
    if arguments.full:
        name, seconds, repetitions = "full", 60.0, 4
        trials = grid(range(1, 9), range(2, 9), range(1, 16), repetitions)
    elif arguments.quick:
        name, seconds, repetitions = "quick", 1.5, 1
        trials = grid((1, 4, 8), (2, 8), (1, 8, 15), repetitions)
    elif arguments.compared:
        name, seconds, repetitions, trials = "compared", 3.0, 3, []
    else:
        name, seconds, repetitions = "default", 5.0, 3
        trials = grid((1, 2, 4, 8), (2, 4, 8), (1, 4, 8, 15), 1)
    trials += beside_the_c_library(repetitions)
    seconds = arguments.seconds or seconds
    folder: Path = arguments.output or Path("build") / f"paper-{name}{'-fifo' if arguments.fifo else ''}"
    folder.mkdir(parents=True, exist_ok=True)
    print(
        f"{os.cpu_count()} cores, {platform.machine()}, Linux {platform.release()}, Python {platform.python_version()},"
        f" load {os.getloadavg()[0]:.1f} before; trials of {seconds:g} s, results in {folder}\n"
    )
    try:
        with own_namespace() as namespace:
            run(trials, folder / "results.csv", seconds, namespace, fifo=arguments.fifo, say=_say)
            faults = []
            if not arguments.compared:
                _say("kills ...")
                rounds = _QUICK_FAULT_ROUNDS if arguments.quick else _FAULT_ROUNDS
                faults = measure_faults(namespace, rounds).lines()
    except KeyboardInterrupt:
        sys.exit("\ninterrupted; the same command goes on from here")
    except (RunFailed, ValueError) as error:
        sys.exit(f"\n{error}")
    _say("")
    rows = load(folder / "results.csv")
    if not arguments.compared:
        print("\n" + "\n".join(effects(rows)))
        try:
            print("\n" + "\n".join(f"{path}" for path in draw(rows, folder)))
        except ImportError as error:
            print(f"\n{error}; no figures drawn. Install the extra: pip install 'skinware[bench]'")
    for lines in (faults, comparison(rows), verdicts(rows), looks(rows)):
        print("\n" + "\n".join(lines))


if __name__ == "__main__":
    main()
