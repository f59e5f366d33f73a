"""A bridge whose ends, driver and link are killed, stopped, restarted, cut and healed at random; and what it leaves.

tools/bench bridge-faults [--faults N] [--seed S] [--mode push|pull] [--sensors N] [--verbose]
tools/bench bridge-faults leaks [--reconnects N] [--restarts N]
tools/bench bridge-faults leaks --in-process [--reconnects N]

The first runs our commands over zenoh through a proxy that can be cut. After each fault a reader has to see that
nothing is fresh, within three periods (0.2 s at least) of the newest data; to be back within 2 s of the cure; never to
see values of one generation under another; and at every frame its ``lost`` has to be exact. ``leaks`` lets the link
break again and again, and counts descriptors, threads, memory and files of both ends. Ends with status 1 if something
does not hold.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from processes import own_namespace

from skinware import DriverReader, DriverWriter, Namespace
from skinware.errors import Overrun, ServiceNotFound, ServiceTimeout, SkinwareError, StructureChanged
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware.status import age_limit_ns
from skinware_drivers.testing.plugin import Belongings
from tests.bridge.net import Net
from tests.bridge.rig import joining, publish, serving, structure
from tests.bridge.slow import SlowLink
from tests.streams.peers import free_port

BIN = Path(sys.executable).parent
RATE_HZ = 50
PERIOD_NS = NS_PER_S // RATE_HZ
PATIENCE_S = 30.0
BACK_S = 2.0
MS, MOST_MS = 1_000_000, 1 << 30
MARGIN_MS = 2
"""By which times in frames are wrong: they are full milliseconds, and are moved by what is known of a clock."""
FASTEST_BITS = 1e10
GROWTH_KIB = 2048
GROWTH_FILES = 12
"""Maps of readers that are closed, and that Python's garbage collector has not taken back yet."""


# -- the driver ---------------------------------------------------------------------------------------------------


def drive(namespace: str, sensors: int, life: int) -> None:
    """Publish until somebody ends it: the number of the frame over all lives, which life this is, and the time, ms."""
    with DriverWriter("arm", structure(sensors, "i4"), namespace=namespace, rate_hz=RATE_HZ) as writer:
        timer, is_told = Periodic(RATE_HZ), False
        while timer.wait():
            columns = writer.begin()
            for column in columns.values():
                column[...] = 0
            time_ns = now_ns()
            columns["values"][0::3] = writer._ring.segment.published + 1
            columns["values"][1::3] = life
            columns["values"][2::3] = time_ns // MS % MOST_MS
            columns["module_time_ns"][:] = time_ns
            writer.commit(time_ns)
            if not is_told:
                is_told = True
                print("ready", flush=True)


# -- what is broken ------------------------------------------------------------------------------------------------


class Program:
    """A program that can be killed, stopped and started again.

    Args:
        command: what it is, each time.
    """

    def __init__(self, command: Callable[[], list[str]]) -> None:
        self._command = command
        self.process: subprocess.Popen[str]
        self.start()

    def start(self) -> None:
        """Start it, and wait until it says something."""
        self.process = subprocess.Popen(self._command(), stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        if not self.process.stdout.readline():
            raise SystemExit(f"{self._command()} ended at once")
        self._reading = threading.Thread(target=self._discard, args=(self.process.stdout,), daemon=True)
        self._reading.start()

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def end(self, number: int = signal.SIGINT) -> None:
        """Have it end, and wait until it has."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.send_signal(number)
            self.process.wait(PATIENCE_S)
        self._reading.join()
        assert self.process.stdout is not None
        self.process.stdout.close()

    @staticmethod
    def _discard(stream: Any) -> None:
        for _ in stream:
            pass


@dataclass
class Setup:
    """All that runs, and can be broken."""

    there: Namespace
    here: Namespace
    proxy: SlowLink
    programs: dict[str, Program]

    def break_(self, what: str, how: str) -> Callable[[], None]:
        """Break something; what makes it good again."""
        if what == "link":
            self.proxy.flows.clear()

            def heal() -> None:
                if how == "cut":
                    self.proxy.cut()
                self.proxy.flows.set()

            return heal
        program = self.programs[what]
        if how == "stop":
            program.send(signal.SIGSTOP)
            return lambda: program.send(signal.SIGCONT)
        program.end(signal.SIGKILL if how == "kill" else signal.SIGINT)
        return program.start


FAULTS = [
    *((what, how) for what in ("serve", "join", "driver") for how in ("kill", "stop", "restart")),
    ("link", "cut"),
    ("link", "hold"),
]


@contextmanager
def running(sensors: int, generator: random.Random, mode: str | None) -> Iterator[Setup]:
    port, lives = free_port(), Counter[str]()
    with ExitStack() as stack:
        there = stack.enter_context(own_namespace())
        here = Namespace(f"{there.name}-here")
        stack.callback(shutil.rmtree, here.path, ignore_errors=True)

        def driver() -> list[str]:
            lives["driver"] += 1
            size = generator.choice((sensors, 2 * sensors))
            return [sys.executable, __file__, "drive", there.name, str(size), str(lives["driver"])]

        def serve() -> list[str]:
            command = ["serve", "--robot", "bench", "--namespace", there.name, "--listen", f"tcp/127.0.0.1:{port}"]
            return [str(BIN / "skin-bridge"), *command, "--json"]

        def join() -> list[str]:
            command = ["join", "bench", "--connect", f"tcp/127.0.0.1:{proxy.port}", "--into", here.name]
            return [str(BIN / "skin-bridge"), *command, "--mode", mode or "auto", "--json"]

        proxy = SlowLink(port, FASTEST_BITS, 0.0)
        stack.callback(proxy.close)
        programs: dict[str, Program] = {}
        for name, command in (("driver", driver), ("serve", serve), ("join", join)):
            programs[name] = Program(command)
            stack.callback(programs[name].end)
        yield Setup(there, here, proxy, programs)


# -- what is seen --------------------------------------------------------------------------------------------------


@dataclass
class Seen:
    """What a reader has seen.

    Attributes:
        newest_ns: time of the newest data, as the frame has it.
        oldest_fresh_ms: how old data was, by the time that its driver wrote into its values, that was fresh still.
        not_fresh_ns: when it was seen first that nothing is fresh since then; 0: something is.
        wrong: what must not be.
    """

    newest_ns: int = 0
    oldest_fresh_ms: int = 0
    not_fresh_ns: int = 0
    number: int = 0
    wrong: list[str] = field(default_factory=list)


class Witness:
    """Reads all the time, in a thread of its own."""

    def __init__(self, here: Namespace) -> None:
        self._here = here
        self._ended = threading.Event()
        self._first: int | None = None
        self._taken = 0
        self._lives: dict[int, int] = {}
        self.seen = Seen()
        self._reader = DriverReader("arm", namespace=here, timeout_s=PATIENCE_S)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def wait(self, condition: Callable[[Seen], bool], timeout_s: float = PATIENCE_S) -> float:
        """Until a condition; how long that took, s, infinite if it does not come true."""
        begin_s = time.monotonic()
        while not condition(self.seen):
            if time.monotonic() - begin_s > timeout_s:
                return float("inf")
            time.sleep(0.002)
        return time.monotonic() - begin_s

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._reader.close()

    def _run(self) -> None:
        known = None
        while not self._ended.is_set():
            try:
                frame = self._reader.read(newer_than=known, timeout_s=0.005)
            except StructureChanged:
                with contextlib.suppress(ServiceNotFound):
                    self._reader.reattach()
                continue
            except (ServiceTimeout, Overrun):
                frame = None
            except SkinwareError as error:
                self.seen.wrong.append(f"{type(error).__name__}: {error}")
                return
            if frame is not None:
                known = frame.position
                self._check(frame)
                last = frame
            elif known is not None:
                frame = last
            if frame is None:
                continue
            looked_ns = now_ns()
            is_fresh = bool(frame.fresh("pressure").any()) and self._reader.alive
            if is_fresh:
                self.seen.not_fresh_ns = 0
                age_ms = (looked_ns // MS - int(frame.values[2])) % MOST_MS
                self.seen.oldest_fresh_ms = max(self.seen.oldest_fresh_ms, age_ms)
            elif not self.seen.not_fresh_ns:
                self.seen.not_fresh_ns = now_ns()

    def _check(self, frame: Any) -> None:
        seen, values = self.seen, frame.values
        number, life = int(values[0]), int(values[1])
        if not ((values[0::3] == number).all() and (values[1::3] == life).all()):
            seen.wrong.append(f"a frame of two: {np.unique(values)}")
        if self._lives.setdefault(frame.generation, life) != life:
            seen.wrong.append(f"life {life} under the structure of life {self._lives[frame.generation]}")
        if self._first is None:
            self._first = number
        if number < seen.number:
            seen.wrong.append(f"frame {number} after {seen.number}")
        self._taken += number != seen.number
        if self._reader.missed + self._taken != number - self._first + 1:
            seen.wrong.append(
                f"lost {self._reader.missed} and took {self._taken} of {number - self._first + 1} frames up to {number}"
            )
            self._first += number - self._first + 1 - self._reader.missed - self._taken  # tell each mistake once
        seen.number, seen.newest_ns = number, frame.acquired_ns


def faults(options: argparse.Namespace) -> bool:
    generator = random.Random(options.seed)
    print(f"seed {options.seed}, {options.sensors} sensors at {RATE_HZ} Hz, load {os.getloadavg()[0]:.1f}", flush=True)
    limit_ms = age_limit_ns(PERIOD_NS) // MS
    stale_ms: list[int] = []
    back_s: list[float] = []
    wrong = 0
    with running(options.sensors, generator, options.mode) as setup:
        witness = Witness(setup.here)
        try:
            for count in range(options.faults):
                what, how = generator.choice(FAULTS)
                witness.wait(lambda seen: not seen.not_fresh_ns)
                time.sleep(0.3 + generator.random())
                lasts_s = generator.choice((0.3, 0.6, 1.2, 3.0, 6.0)) * (0.7 + 0.6 * generator.random())
                heal = setup.break_(what, how)
                begin_s, witness.seen.oldest_fresh_ms = time.monotonic(), 0
                witness.wait(lambda seen: bool(seen.not_fresh_ns))
                stale_ms.append(witness.seen.oldest_fresh_ms)
                time.sleep(max(0.0, lasts_s - (time.monotonic() - begin_s)))
                heal()
                healed_ns = now_ns()
                witness.wait(lambda seen: not seen.not_fresh_ns and seen.newest_ns > healed_ns)  # noqa: B023
                back_s.append((now_ns() - healed_ns) / 1e9)
                told = f"{count + 1:3} {what} {how}, {lasts_s:.1f} s: fresh for {stale_ms[-1]} ms"
                bad = list(witness.seen.wrong)
                witness.seen.wrong.clear()
                if stale_ms[-1] > limit_ms + MARGIN_MS:
                    bad.append("stale too late")
                if back_s[-1] > BACK_S:
                    bad.append("back too late")
                wrong += len(bad)
                if options.verbose or bad:
                    print(
                        f"{told}, back after {1e3 * back_s[-1]:.0f} ms{'; WRONG: ' if bad else ''}{'; '.join(bad)}",
                        flush=True,
                    )
        finally:
            witness.close()
    print(
        f"{options.faults} faults: data was fresh until it was {np.median(stale_ms):.0f} ms old (at most"
        f" {max(stale_ms)}), back {1e3 * np.median(back_s):.0f} ms after the cure (at most"
        f" {1e3 * max(back_s):.0f}); {wrong} wrong"
    )
    return not wrong


# -- what is left --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Belonging:
    """What a process has, and files in shared memory."""

    files: int
    threads: int
    memory_kib: int
    shared: int

    @staticmethod
    def of(pid: int, *places: Namespace) -> Belonging:
        status = dict(
            line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line
        )
        shared = sum(1 for place in places for path in place.path.rglob("*") if path.is_file())
        files = len(os.listdir(f"/proc/{pid}/fd"))
        return Belonging(files, int(status["Threads"]), int(status["VmRSS"].split()[0]), shared)

    def __str__(self) -> str:
        return f"{self.files} descriptors, {self.threads} threads, {self.memory_kib:,} KiB, {self.shared} shared files"


def leaks(options: argparse.Namespace) -> bool:
    """The link breaks and is back, again and again; then the joiner is started anew again and again."""
    print(f"{options.reconnects} reconnects, {options.restarts} restarts over zenoh, load {os.getloadavg()[0]:.1f}")
    with running(options.sensors, random.Random(1), options.mode) as setup:
        witness = Witness(setup.here)

        def back() -> None:
            healed_ns = now_ns()
            if witness.wait(lambda seen: not seen.not_fresh_ns and seen.newest_ns > healed_ns) > PATIENCE_S:
                raise SystemExit("it did not come back")

        def reconnect() -> None:
            setup.proxy.cut()
            back()

        def restart() -> None:
            setup.programs["join"].end(signal.SIGKILL)
            setup.programs["join"].start()
            back()

        try:
            back()
            all_well = _watched(setup, ("serve", "join"), options.reconnects, reconnect, "reconnects")
            return _watched(setup, ("serve",), options.restarts, restart, "restarts of join") and all_well
        finally:
            witness.close()


def _watched(setup: Setup, names: tuple[str, ...], times: int, once: Callable[[], None], what: str) -> bool:
    begun: dict[str, Belonging] = {}
    for count in range(times):
        if count == times // 3:
            begun = {name: Belonging.of(setup.programs[name].process.pid, setup.there, setup.here) for name in names}
        once()
    time.sleep(12)  # who asks for frames no more is forgotten after 10 s
    all_well = True
    for name in names:
        now = Belonging.of(setup.programs[name].process.pid, setup.there, setup.here)
        print(f"  {name}, {times // 3} {what}: {begun[name]}; {times}: {now}", flush=True)
        all_well &= _is_no_more(begun[name], now)
    return all_well


def _is_no_more(before: Belonging, now: Belonging) -> bool:
    return (
        now.files <= before.files + GROWTH_FILES
        and now.threads <= before.threads
        and now.shared <= before.shared
        and now.memory_kib <= before.memory_kib + GROWTH_KIB
    )


def leaks_in_process(options: argparse.Namespace) -> bool:
    """Both ends in this process, over the network that tests have: the robot's end goes and comes."""
    print(f"{options.reconnects} reconnects in this process, load {os.getloadavg()[0]:.1f}")
    with ExitStack() as stack:
        there = stack.enter_context(own_namespace())
        here = Namespace(f"{there.name}-here")
        stack.callback(shutil.rmtree, here.path, ignore_errors=True)
        net = Net()
        stack.callback(net.close)
        writer = stack.enter_context(DriverWriter("arm", structure(64), namespace=there, rate_hz=RATE_HZ))
        ends = stack.enter_context(joining(net, there, options.mode))
        begun = Belonging.of(os.getpid(), there, here)
        belongings = Belongings()
        number = 0
        for count in range(options.reconnects):
            if count == options.reconnects // 3:
                gc.collect()
                begun, belongings = Belonging.of(os.getpid(), there, here), Belongings()
            with serving(net, there):
                end_s = time.monotonic() + PATIENCE_S
                while not _has_arrived(here, number):
                    number = publish(writer)
                    time.sleep(0.002)
                    if time.monotonic() > end_s:
                        raise SystemExit("it did not come back")
            while ends.joiner.is_connected:
                time.sleep(0.001)
            net.answered.clear()  # what the network of tests remembers
            ends.events.clear()
        gc.collect()
        now, left = Belonging.of(os.getpid(), there, here), belongings.left_since()
    print(f"  {options.reconnects // 3}: {begun}; {options.reconnects}: {now}; left: {', '.join(left) or 'nothing'}")
    return _is_no_more(begun, now) and not left


def _has_arrived(here: Namespace, number: int) -> bool:
    try:
        with DriverReader("arm", namespace=here, announce=False) as reader:
            return bool(number) and int(reader.read(timeout_s=0).values[0]) >= number
    except SkinwareError:
        return False


def main() -> None:
    if sys.argv[1:2] == ["drive"]:
        with contextlib.suppress(KeyboardInterrupt):
            drive(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=["faults", "leaks"], default="faults")
    parser.add_argument("--faults", type=int, default=50)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 16))
    parser.add_argument("--mode", choices=["push", "pull"])
    parser.add_argument("--sensors", type=int, default=768)
    parser.add_argument("--reconnects", type=int, default=300)
    parser.add_argument("--restarts", type=int, default=30)
    parser.add_argument("--in-process", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    run = faults if options.what == "faults" else leaks_in_process if options.in_process else leaks
    sys.exit(0 if run(options) else 1)


if __name__ == "__main__":
    main()
