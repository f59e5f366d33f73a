"""The core beside a C program, iceoryx2 and zenoh: publish time, age at the reader, loss and CPU, in interleaved runs.

A writer and 1, 4 or 15 readers, each in a process of its own; uint16 values; every reader wakes on data, takes every
message in order, copies it into an array of its own and checks that it is whole. The age is the time from the stamp
that the writer puts into the message just before it hands it over, to the reader holding its copy. Each repetition
runs every cell with one product after the other; the table shows medians over the repetitions.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import socket
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from core_products import NAMES, products
from core_run import Cell, Result, measure
from processes import RunFailed, may_use_fifo, own_namespace

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.realtime import now_ns

OURS, PEER, IN_C = "skinware", "iceoryx2", "c"
SENSORS, READERS, RATES = (256, 4096, 30848), (1, 4, 15), (100, 1000)
_VIEWS = 2000
_MOST_OF_C, _MOST_PUBLISH_US, _MOST_VIEW_SPREAD = 1.2, 20.0, 1.2

Results = dict[tuple[Cell, str], list[Result]]


def view_costs(namespace: Namespace, sensors: Iterable[int], rounds: int) -> dict[int, float]:
    """Microseconds to take a zero-copy view of the newest frame and to check it after use, by number of sensors."""
    costs: dict[int, list[float]] = defaultdict(list)
    for _ in range(rounds):
        for count in sensors:
            with ServiceWriter("view", {"values": ("<u2", count)}, namespace=namespace) as writer:
                writer.begin()["values"][:] = 1
                writer.commit(now_ns())
                with ServiceReader[Sample]("view", namespace=namespace, announce=False) as reader:
                    passed = []
                    for _ in range(_VIEWS):
                        begin_ns = now_ns()
                        with reader.view() as frame:
                            whole = frame.column("values")[0] == 1 and frame.valid
                        passed.append(now_ns() - begin_ns)
                        assert whole
            costs[count].append(float(np.median(passed)) / 1000)
    return {count: statistics.median(rounds) for count, rounds in costs.items()}


def cells(arguments: argparse.Namespace) -> list[Cell]:
    """The matrix; under normal scheduling also the cell of the real-time target, if this user may."""
    fifo = may_use_fifo()
    if arguments.fifo and not fifo:
        sys.exit("--fifo: this user may not use SCHED_FIFO (run as root, or raise rtprio in /etc/security/limits.conf)")
    profile = "fifo" if arguments.fifo else "normal"
    matrix = [
        Cell(sensors, readers, rate, profile)
        for rate in arguments.rates
        for readers in arguments.readers
        for sensors in arguments.sensors
    ]
    if fifo and not arguments.fifo:
        matrix += [Cell(sensors, 15, 1000, "fifo") for sensors in arguments.sensors if 15 in arguments.readers]
    return matrix


def run_all(arguments: argparse.Namespace, namespace: Namespace, matrix: list[Cell]) -> Results:
    """Every cell with every product, ``--runs`` times, in turns."""
    results: Results = defaultdict(list)
    chosen = products(arguments.products, namespace, _free_port())
    total, done, begin = arguments.runs * len(matrix) * len(chosen), 0, time.monotonic()
    for run in range(arguments.runs):
        for cell in matrix:
            for product in chosen:
                try:
                    results[cell, product.name].append(measure(product, cell, arguments.seconds))
                except RunFailed as error:
                    print(f"\n{product.name}, {cell}: {error}", file=sys.stderr)
                done += 1
                left_s = (time.monotonic() - begin) / done * (total - done)
                progress = f"run {run + 1} of {arguments.runs}, {done} of {total}, {left_s:.0f} s left"
                print(f"\r{progress:60}", end="", file=sys.stderr, flush=True)
    print(f"\r{'':60}\r", end="", file=sys.stderr)
    return results


def median(results: Results, cell: Cell, product: str, what: str) -> float:
    """Median over the runs of a cell; NaN if none succeeded."""
    values = [result.row()[what] for result in results.get((cell, product), [])]
    return statistics.median(values) if values else float("nan")


def table(results: Results, matrix: list[Cell], names: list[str]) -> str:
    """The results in Markdown: one row per cell, the products side by side."""
    columns = (
        ("publish µs", "publish_us", "{:.0f}"),
        ("age µs", "age_us", "{:.0f}"),
        ("age p99 µs", "age_p99_us", "{:.0f}"),
        ("lost %", "lost_percent", "{:.2f}"),
        ("CPU % writer", "writer_cpu_percent", "{:.1f}"),
        ("CPU % a reader", "reader_cpu_percent", "{:.1f}"),
    )
    titles = [
        "Hz",
        "readers",
        "sensors",
        *(title for title, _, _ in columns),
        f"age {OURS} : {PEER}",
        f"age {OURS} : {IN_C}",
    ]
    lines = [f"Medians of {' / '.join(names)}:", "", f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    for cell in matrix:
        fields = [f"{cell.rate_hz}{' fifo' if cell.profile == 'fifo' else ''}", f"{cell.readers}", f"{cell.sensors}"]
        for _, what, form in columns:
            fields.append(" / ".join(form.format(median(results, cell, name, what)) for name in names))
        fields += [f"{age_ratio(results, cell, PEER):.2f}", f"{age_ratio(results, cell, IN_C):.2f}"]
        lines.append(f"| {' | '.join(fields)} |")
    return "\n".join(lines)


def age_ratio(results: Results, cell: Cell, other: str) -> float:
    """Our age over another's: the median over the runs, each of which has both. Below 1 is better; NaN without them."""
    pairs = zip(results.get((cell, OURS), []), results.get((cell, other), []), strict=False)
    ratios = [ours.age_us / theirs.age_us for ours, theirs in pairs]
    return statistics.median(ratios) if ratios else float("nan")


def verdicts(results: Results, matrix: list[Cell], views: dict[int, float]) -> list[str]:
    """What became of each target, in words."""
    lines = []
    compared = [cell for cell in matrix if cell.profile == matrix[0].profile]

    def say(good: bool, text: str) -> None:
        lines.append(f"{'met   ' if good else 'MISSED'} {text}")

    for other, limit, text in (
        (PEER, 1.0, f"better than {PEER}'s"),
        (IN_C, _MOST_OF_C, "at most 1.2 times a C program's"),
    ):
        ratios = {cell: age_ratio(results, cell, other) for cell in compared}
        known = {cell: ratio for cell, ratio in ratios.items() if ratio == ratio}
        if known:
            good = sum(ratio < limit for ratio in known.values())
            worst = max(known, key=lambda cell: known[cell])
            say(
                good == len(known),
                f"age {text} in every row: {good} of {len(known)}; at most {known[worst]:.2f} times"
                f" ({worst.sensors} sensors, {worst.readers} readers, {worst.rate_hz} Hz)",
            )
    for cell in compared:
        if cell.readers == 1 and cell.rate_hz == 1000:
            value = median(results, cell, OURS, "publish_us")
            text = f"publish <= {_MOST_PUBLISH_US:.0f} us, 1000 Hz, 1 reader, {cell.sensors}: {value:.1f} us"
            say(value <= _MOST_PUBLISH_US, text)
    for cell in matrix:
        if cell.profile == "fifo" and cell.readers == 15 and cell.rate_hz == 1000:
            runs = [result.lost_percent for result in results[cell, OURS]]
            say(not any(runs), f"fifo, 15 readers, 1000 Hz, {cell.sensors}: lost at most {max(runs, default=0):.3f} %")
    torn = sum(result.torn for (_, name), runs in results.items() if name == OURS for result in runs)
    say(torn == 0, f"torn messages: {torn}")
    if len(views) > 1:
        spread = max(views.values()) / min(views.values())
        costs = ", ".join(f"{cost:.2f} us for {count}" for count, cost in views.items())
        say(spread <= _MOST_VIEW_SPREAD, f"a view costs the same for every size within 20 %: {costs}")
    return lines


def write_csv(path: Path, results: Results) -> None:
    """Every run, one row each."""
    with path.open("w", newline="") as file:
        writer = None
        for (cell, product), runs in results.items():
            for number, result in enumerate(runs):
                row = {"run": number, "product": product, **vars(cell), **result.row()}
                writer = writer or csv.DictWriter(file, row)
                if number == 0 and file.tell() == 0:
                    writer.writeheader()
                writer.writerow(row)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="about 2 minutes: 2 runs of a part of the matrix")
    parser.add_argument("--fifo", action="store_true", help="the whole matrix with SCHED_FIFO (writer 50, readers 40)")
    parser.add_argument("--runs", type=int, help="repetitions (default: 5)")
    parser.add_argument("--seconds", type=float, help="measured time of each run (default: 2)")
    parser.add_argument("--sensors", type=_numbers, help="comma-separated (default: 256,4096,30848)")
    parser.add_argument("--readers", type=_numbers, help="comma-separated, at most 16 (default: 1,4,15)")
    parser.add_argument("--rates", type=_numbers, help="Hz, comma-separated (default: 100,1000)")
    parser.add_argument("--products", type=lambda text: text.split(","), default=list(NAMES[:4]), help=", ".join(NAMES))
    parser.add_argument("--csv", type=Path, help="write every run's figures to this file")
    arguments = parser.parse_args()
    quick = arguments.quick
    arguments.runs = arguments.runs or (2 if quick else 5)
    arguments.seconds = arguments.seconds or (1.0 if quick else 2.0)
    arguments.sensors = arguments.sensors or ([256, 30848] if quick else list(SENSORS))
    arguments.readers = arguments.readers or ([1, 15] if quick else list(READERS))
    arguments.rates = arguments.rates or list(RATES)
    unknown = set(arguments.products) - set(NAMES)
    if unknown:
        parser.error(f"unknown product {', '.join(sorted(unknown))}; there are: {', '.join(NAMES)}")
    load = os.getloadavg()[0]
    print(
        f"{os.cpu_count()} cores, {platform.machine()}, Linux {platform.release()}, Python {platform.python_version()},"
        f" load {load:.1f} before; {arguments.runs} interleaved runs of {arguments.seconds:g} s\n"
    )
    matrix = cells(arguments)
    try:
        with own_namespace() as namespace:
            views = view_costs(namespace, arguments.sensors, 2 * arguments.runs + 1)
            results = run_all(arguments, namespace, matrix)
    except ImportError as error:
        sys.exit(f"{error}; install the extra: pip install 'skinware[bench]'")
    if arguments.csv is not None:
        write_csv(arguments.csv, results)
    print(table(results, matrix, arguments.products), end="\n\n")
    print("\n".join(verdicts(results, matrix, views)))


if __name__ == "__main__":
    main()
