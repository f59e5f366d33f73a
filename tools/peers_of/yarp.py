"""Programs of YARP, built from source, against our driver and our ports: every value that they send and read.

``yarp.cpp`` is a port of 192-value Vectors at 50 Hz and a reader of such a port. Our driver reads the port,
``skin-bridge yarp`` serves what it read, and a C++ reader and ``yarp read`` read that. Publisher, readers, driver and
bridge are ended, killed and begun again in turns; a publisher that ends by itself is a crash.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware import DriverReader
from skinware.errors import SkinwareError
from skinware.yarp.names import NameServer
from skinware_drivers.streams.yarp_bus import YarpBus
from skinware_drivers.streams.yarp_messages import YarpMessages

HERE, PROJECT = Path(__file__).parent, Path(__file__).parents[2]
OPTIONS = {
    "CMAKE_BUILD_TYPE": "Release",
    "SKIP_ACE": "ON",
    "SKIP_ThrottleDown": "ON",  # of 4.0.0, which cannot be configured with it and without its carrier
    "YARP_COMPILE_CARRIER_PLUGINS": "OFF",
    "YARP_COMPILE_GUIS": "OFF",
    "YARP_COMPILE_PORTMONITOR_PLUGINS": "OFF",
    "YARP_COMPILE_TESTS": "OFF",
    "YARP_COMPILE_libYARP_math": "OFF",
}
TARGETS = ("yarpserver", "yarp", "YARP_sig", "YARP_init")
PUBLISHED, SERVED = "/peer/skin", "/skinware/skin"
VALUES, PERIOD, STEP = 192, 2040, 8.0
"""As in yarp.cpp."""
TURN_S, LOOK_S = 4.0, 60.0


def version_of(source: Path) -> str:
    """What YARP says it is.

    Raises:
        SystemExit: the folder is none of its sources.
    """
    text = (source / "CMakeLists.txt").read_text() if (source / "CMakeLists.txt").exists() else ""
    match = re.search(r"project\(\s*YARP\s+VERSION\s+([0-9.]+)", text)
    if match is None:
        sys.exit(f"{source}: this folder has no sources of YARP; git clone https://github.com/robotology/yarp")
    return match[1]


def built(source: Path, build: Path) -> Path:
    """Build what is needed of YARP, and ``yarp.cpp``; CMake finds YCM by CMAKE_PREFIX_PATH. Gives the program."""
    build.mkdir(parents=True, exist_ok=True)
    log = build / "skinware.log"
    jobs = str(os.cpu_count() or 1)
    program = build / "skinware_peer"
    folders = [f"{root}/src/libYARP_{part}/src" for root in (source, build) for part in ("os", "sig", "conf")]
    compiler = ["c++", "-std=c++17", "-O2", *(f"-I{each}" for each in folders)]
    libraries = [f"-L{build}/lib", f"-Wl,-rpath,{build}/lib", "-lYARP_sig", "-lYARP_init", "-lYARP_os"]
    with log.open("w") as output:
        for command in (
            ["cmake", "-S", str(source), "-B", str(build), *(f"-D{name}={value}" for name, value in OPTIONS.items())],
            ["cmake", "--build", str(build), "-j", jobs, "--target", *TARGETS],
            [*compiler, str(HERE / "yarp.cpp"), "-o", str(program), *libraries],
        ):
            if subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, check=False).returncode:
                sys.exit(f"{command[0]} failed: see {log}")
    return program


class Program:
    """A program that runs; its lines are handed to ``hear``, from a thread."""

    def __init__(
        self, command: list[str], environment: dict[str, str], hear: Callable[[str], object] = lambda _: None
    ) -> None:
        self.process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._lines: list[str] = []
        self._hear = hear
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._hear(line.rstrip())
            self._lines = [*self._lines[-20:], line.rstrip()]

    @property
    def lines(self) -> list[str]:
        """The last ones."""
        return self._lines

    def end(self, by: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal unless it has ended already; gives its status."""
        status = self.process.poll()
        if status is None:
            self.process.send_signal(by)
            try:
                status = self.process.wait(15)
            except subprocess.TimeoutExpired:
                self.process.kill()
                status = self.process.wait()
        self._thread.join(5)
        return status


@dataclass
class Counts:
    """What was counted, of one direction or program."""

    vectors: int = 0
    inexact: int = 0
    blank: int = 0
    mixed: int = 0
    begun: int = 0
    crashed: list[str] = field(default_factory=list)


def check(values: npt.NDArray[np.floating], counts: Counts) -> None:
    """Count a vector, and whether it is one that yarp.cpp made."""
    counts.vectors += 1
    first = values.reshape(-1, 12)[:, 0] * STEP
    made = (first[:, None] + np.arange(12)) % PERIOD / STEP
    if not values.any():
        counts.blank += 1
    elif len(values) != VALUES or not np.array_equal(values.reshape(-1, 12), made):
        counts.inexact += 1
    elif not np.array_equal((first[0] + 12 * np.arange(len(first))) % PERIOD, first):
        counts.mixed += 1


class Meeting:
    """A name server of YARP, and everything that meets there.

    Args:
        build: where YARP was built.
        program: yarp.cpp's.
        version: of YARP.
        folder: for its configuration, empty.
    """

    def __init__(self, build: Path, program: Path, version: str, folder: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            number = probe.getsockname()[1]
        self._yarp, self._program, self._major = str(build / "bin" / "yarp"), str(program), version.partition(".")[0]
        self._environment = {
            **os.environ,
            "SKINWARE_NAMESPACE": f"yarp-{os.getpid()}",
            **{f"YARP_{each}_HOME": folder for each in ("CONFIG", "DATA", "CACHE")},
        }
        Path(folder, "yarp.conf").write_text(f"127.0.0.1 {number} yarp\n")  # by --read alone it stays on loopback
        os.environ["SKINWARE_NAMESPACE"] = self._environment["SKINWARE_NAMESPACE"]
        self.names = NameServer("127.0.0.1", number)
        where = ["--ip", "127.0.0.1", "--socket", str(number), "--read"]
        self.server = self._begin(
            [str(build / "bin" / "yarpserver"), "--portdb", ":memory:", "--subdb", ":memory:", *where]
        )
        self.counts = {each: Counts() for each in ("publisher", "driver", "cpp", "text", "bridge")}
        self.running: dict[str, Program] = {}
        self.troubles: list[str] = []
        self.visits = 0
        self._over = threading.Event()
        self._reader = threading.Thread(target=self._read)

    def _begin(self, command: list[str], hear: Callable[[str], object] = lambda _: None) -> Program:
        return Program(command, self._environment, hear)

    # -- each of them ----------------------------------------------------------------------------------------------

    def begin(self, name: str) -> None:
        """Begin one again."""
        server = f"{self.names.host}:{self.names.port}"
        begin: dict[str, Callable[[], Program]] = {
            "publisher": lambda: self._begin([self._program, "publish", PUBLISHED]),
            "driver": lambda: self._begin(
                ["skin-driver", "--driver", "yarp", "--bus", f"yarp://{server}{PUBLISHED}", "--wait"]
            ),
            "bridge": lambda: self._begin(["skin-bridge", "yarp", "--yarp", self._major, "--server", server]),
            "cpp": lambda: self._begin([self._program, "read", "/peer/cpp", SERVED, "tcp"], self._hear_cpp()),
            "text": lambda: self._begin([self._yarp, "read", "/peer/text", SERVED], self._hear_text),
        }
        self.counts[name].begun += 1
        self.running[name] = begin[name]()

    def end(self, name: str, by: signal.Signals) -> None:
        """End one; a crash is counted."""
        program = self.running.pop(name)
        self._note(name, program)
        program.end(by)

    def _note(self, name: str, program: Program) -> None:
        if (status := program.process.poll()) is not None:
            self.counts[name].crashed.append(f"{status}: {' / '.join(program.lines[-3:])}")

    def _hear_cpp(self) -> Callable[[str], None]:
        heard = [0, 0, 0]
        counts = self.counts["cpp"]

        def hear(line: str) -> None:
            if re.fullmatch(r"\d+ \d+ \d+", line):
                now = [int(word) for word in line.split()]
                counts.vectors += now[0] - heard[0]
                counts.inexact += now[1] - heard[1]
                counts.blank += now[2] - heard[2]
                heard[:] = now

        return hear

    def _hear_text(self, line: str) -> None:
        words = line.split()
        if len(words) == VALUES and not line.startswith("["):
            check(np.array([float(word) for word in words]), self.counts["text"])

    def _read(self) -> None:
        """Follow our driver, whenever it runs."""
        while not self._over.is_set():
            with contextlib.suppress(SkinwareError, OSError), DriverReader("yarp") as reader:
                frame = None
                while not self._over.is_set():
                    frame = reader.read(newer_than=frame, timeout_s=1.0)
                    if not frame.status.any():
                        check(frame.values.astype(np.float64), self.counts["driver"])
            self._over.wait(0.05)

    # -- all of them -----------------------------------------------------------------------------------------------

    def meet(self, hours: float) -> None:
        """Have them run so long, one after the other ended or killed and begun again."""
        self._reader.start()
        self._wait_until_known("/root")
        for name in ("publisher", "driver", "bridge", "cpp", "text"):
            self.begin(name)
            if name != "publisher":
                self._wait_for(name)
        since_s = time.monotonic()
        until_s, minutes, turns = since_s + 3600 * hours, 0, random.Random(24)
        while (now_s := time.monotonic()) < until_s:
            if now_s - since_s >= 60 * (minutes + 1):
                minutes += 1
                print(f"{minutes} minutes: {self.in_words()}", file=sys.stderr, flush=True)
            name = turns.choice(["publisher", "driver", "driver", "bridge", "cpp", "text"])
            self.end(name, turns.choice([signal.SIGTERM, signal.SIGKILL]))
            self._visit(turns.randrange(4))
            self.begin(name)
            if name == "bridge":  # their connections ended with it: nothing but they can make them again
                for reader in ("cpp", "text"):
                    self.end(reader, signal.SIGTERM)
                self._wait_until_known(SERVED)
                for reader in ("cpp", "text"):
                    self.begin(reader)
            for each in self.running:
                self._wait_for(each)
            self._over.wait(min(TURN_S, max(0.0, until_s - time.monotonic())))

    def _visit(self, times: int) -> None:
        """Connect to the publisher as our driver does, and hang up again at once."""
        for _ in range(times):
            with contextlib.suppress(OSError, SkinwareError):
                bus = YarpBus(f"{self.names.host}:{self.names.port}{PUBLISHED}", payload_size=56)
                bus.use(YarpMessages())
                bus.open()
                bus.close()
                self.visits += 1

    def _wait_for(self, name: str) -> None:
        """Wait until one has begun: until vectors come where it is followed, or its port is known."""
        counts = self.counts[{"publisher": "driver", "bridge": "bridge"}.get(name, name)]
        if name == "bridge":
            self._wait_until_known(SERVED)
            return
        before, until_s = counts.vectors, time.monotonic() + LOOK_S
        while counts.vectors == before and not self._over.wait(0.02):
            if time.monotonic() > until_s:
                self.troubles.append(f"nothing came for {LOOK_S:g} s of {name}: {self.running[name].lines[-3:]}")
                return

    def _wait_until_known(self, port: str) -> None:
        until_s = time.monotonic() + LOOK_S
        while not self._is_there(port):
            if self._over.wait(0.1) or time.monotonic() > until_s:
                self.troubles.append(f"{port} was not known within {LOOK_S:g} s")
                return

    def _is_there(self, port: str) -> bool:
        with contextlib.suppress(OSError):
            if contact := self.names.query(port):
                socket.create_connection((contact.host, contact.port), 1).close()
                return True
        return False

    def ask(self) -> str:
        """What our port answers ``yarp admin rpc``, which asks in binary."""
        command = [self._yarp, "admin", "rpc", SERVED]
        try:
            done = subprocess.run(
                command,
                env=self._environment,
                input="[ver]\n",
                capture_output=True,
                text=True,
                timeout=LOOK_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"nothing within {LOOK_S:g} s"
        return done.stdout.strip()

    @property
    def read(self) -> list[tuple[Counts, str]]:
        """What was read, and by whom."""
        counts = self.counts
        return [(counts["driver"], "our driver"), (counts["cpp"], "a C++ reader"), (counts["text"], "yarp read")]

    def in_words(self) -> str:
        """What was counted so far."""
        read = ", ".join(f"{each.vectors} by {who} ({each.blank} blank)" for each, who in self.read)
        begun = ", ".join(f"{name} {each.begun}" for name, each in self.counts.items())
        return (
            f"vectors of {VALUES} values {read}, inexact {sum(each.inexact for each, _ in self.read)}; begun {begun};"
            f" {self.visits} short calls; crashes of the publisher {len(self.counts['publisher'].crashed)}"
        )

    def close(self) -> None:
        """End all."""
        self._over.set()
        for name in list(self.running):
            self.end(name, signal.SIGTERM)
        self._reader.join()
        self.server.end(signal.SIGKILL)


def compare(source: Path, build: Path, hours: float) -> bool:
    """Meet one YARP; prints what agreed and what differs, and gives whether nothing did."""
    version = version_of(source)
    program = built(source, build)
    print(f"program: YARP {version}", flush=True)
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Meeting(build, program, version, folder)) as all_:
        since_s = time.monotonic()
        all_.meet(hours)
        answer = all_.ask()
        minutes = (time.monotonic() - since_s) / 60
    counts, read = all_.counts, all_.read
    differs = [
        *all_.troubles,
        *(f"{who}: {each.inexact} of {each.vectors} vectors inexact" for each, who in read if each.inexact),
        *(f"{who}: {each.mixed} frames of two vectors" for each, who in read if each.mixed),
        *(f"{who}: no vector" for each, who in read if not each.vectors),
        *(f"{name} ended by itself: {each}" for name in counts for each in counts[name].crashed),
        *([] if "Response: [ver] 1 2 3" in answer else [f"yarp admin rpc shows {answer!r}"]),
    ]
    for each in differs:
        print(f"differs: {each}", flush=True)
    print(f"agreed: {minutes:.0f} minutes; {all_.in_words()}", flush=True)
    return not differs


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, help="sources of YARP")
    parser.add_argument("--build", type=Path, help="where it is built; default: build/yarp-VERSION of the project")
    parser.add_argument("--hours", type=float, default=0.02, help="how long they run")
    options = parser.parse_args()
    build = options.build or PROJECT / "build" / f"yarp-{version_of(options.source)}"
    return int(not compare(options.source.resolve(), build.resolve(), options.hours))


if __name__ == "__main__":
    sys.exit(main())
