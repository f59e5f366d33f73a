"""Links between the two ends of a bridge, and these ends as people start them.

A machine is a network namespace, a link a pair of veth between two of them, a slow link one with tbf at both ends.
Where these cannot be made (not root, no iproute2), both ends are on the loopback, and a proxy makes a link slow.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

from processes import RunFailed

from tests.bridge.slow import slow_link

BIN = Path(sys.executable).parent
LOOPBACK = "127.0.0.1"
PATIENCE_S = 30.0
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_CLONE_NEWNET = 0x40000000


def run(*command: str) -> str:
    """What a command prints.

    Raises:
        OSError: it failed, or is not installed.
    """
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except FileNotFoundError:
        raise OSError(f"{command[0]} is not installed") from None
    except subprocess.CalledProcessError as error:
        raise OSError(error.stderr.strip()) from None


@contextmanager
def machine(role: str) -> Iterator[str]:
    """A network namespace, removed afterwards with all links to it; its name.

    Raises:
        OSError: it cannot be made.
    """
    name = f"skin-{os.getpid()}-{role}"
    run("ip", "netns", "add", name)
    try:
        run("ip", "-n", name, "link", "set", "lo", "up")
        yield name
    finally:
        run("ip", "netns", "del", name)


def connect(here: str, there: str, number: int, mbit: float | None) -> str:
    """Make link ``number`` between two machines, with so many Mbit/s each way (None: as fast as it is).

    Returns:
        The address of ``here``.

    Raises:
        OSError: it cannot be made.
    """
    device = device_of(number)
    run("ip", "-n", here, "link", "add", device, "type", "veth", "peer", "name", device, "netns", there)
    for end, place in enumerate((here, there), 1):
        run("ip", "-n", place, "addr", "add", f"10.77.{number}.{end}/24", "dev", device)
        run("ip", "-n", place, "link", "set", device, "up")
        if mbit is not None:
            shape = ("tbf", "rate", f"{mbit:g}mbit", "burst", "32kb", "latency", "50ms")
            run("tc", "-n", place, "qdisc", "add", "dev", device, "root", *shape)
    return f"10.77.{number}.1"


def device_of(number: int) -> str:
    """Of a link, at both of its ends."""
    return f"link{number}"


def sent_bytes(place: str, number: int) -> int:
    """What an end of a link has sent until now, with the headers of TCP, IP and Ethernet."""
    told = json.loads(run("ip", "-n", place, "-s", "-j", "link", "show", "dev", device_of(number)))
    return int(told[0]["stats64"]["tx"]["bytes"])


def why_no_machines() -> str:
    """Why no links between machines can be made here; empty if they can."""
    try:
        with machine("a") as here, machine("b") as there:
            connect(here, there, 1, 16)
    except OSError as error:
        return str(error)
    return ""


def enter(place: str | None) -> None:
    """Go to a machine, with all threads that this one starts later.

    Raises:
        OSError: it is not there.
    """
    if place is None:
        return
    with open(f"/run/netns/{place}") as file:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.setns(file.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def free_ports(count: int) -> list[int]:
    """Ports at which nobody listens now."""
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.create_server((LOOPBACK, 0))) for _ in range(count)]
        return [probe.getsockname()[1] for probe in probes]


def proxy(pipe: Connection, ports: list[int], bits_per_s: float) -> None:
    """Process of slow links on the loopback, one to each port, until the other end says enough; tells their ports."""
    with ExitStack() as stack:
        pipe.send([stack.enter_context(slow_link(port, bits_per_s)).port for port in ports])
        with contextlib.suppress(EOFError):
            pipe.recv()


class Command:
    """``skin-bridge`` with what it says. Leaving its block ends it, whatever it does.

    Args:
        arguments: of the command.
        place: on which machine it runs.

    Raises:
        RunFailed: it is not ready; says why.
    """

    def __init__(self, *arguments: str, place: str | None = None) -> None:
        inside = ["ip", "netns", "exec", place] if place else []
        self._what = f"skin-bridge {' '.join(arguments)}"
        self._process = subprocess.Popen(
            [*inside, str(BIN / "skin-bridge"), *arguments, "--json"], stdout=subprocess.PIPE, text=True
        )
        self.begin()

    def __enter__(self) -> Self:
        assert self._process.stdout is not None
        try:
            if not self._process.stdout.readline():
                raise RunFailed(f"{self._what} ended at once")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._process.pid

    def begin(self) -> None:
        """Count processor time from now on."""
        self._begin = cpu_s(self.pid), time.monotonic()

    def share(self) -> float:
        """Of a core, since ``begin``."""
        before_s, begin_s = self._begin
        return (cpu_s(self.pid) - before_s) / (time.monotonic() - begin_s)

    def end(self) -> list[dict[str, Any]]:
        """End it as Ctrl-C does; its events."""
        self._process.send_signal(signal.SIGINT)
        out, _ = self._process.communicate(timeout=PATIENCE_S)
        return [json.loads(line) for line in out.splitlines()]


def cpu_s(pid: int) -> float:
    """Processor time that a process has taken."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def memory_mb(pid: int) -> float:
    """Memory of a process alone: without files, and without what it shares in shared memory."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1024
    return float("nan")


def descriptors(pid: int) -> int:
    """Open files of a process."""
    return len(os.listdir(f"/proc/{pid}/fd"))
