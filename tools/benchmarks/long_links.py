"""Links with delay, jitter and loss: IP packets between two machines, carried by a process that holds and drops them.

Linux has ``tc netem`` for this, where the kernel was built with it. Here each machine has a TUN device, and a process
of high priority passes on what comes out of one, later, into the other. TCP of both machines is that of the kernel, so
it does what it does on such a link: retransmits, waits, and sends more slowly after losses. Packets keep their order.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import random
import select
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection

from links import PATIENCE_S, enter, run
from processes import Processes, answer, may_use_fifo, use_fifo

_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_PACKET = 2048


@dataclass(frozen=True)
class Far:
    """What a link is like, each way.

    Attributes:
        delay_ms: that every packet takes.
        jitter_ms: that it takes at most beyond that, each as likely.
        loss: share of packets that do not arrive.
        tcp: how TCP finds out how much it may send: ``cubic``, as Linux has it by default, or ``bbr``.
    """

    delay_ms: float
    jitter_ms: float = 0.0
    loss: float = 0.0
    tcp: str = "cubic"

    def __str__(self) -> str:
        jitter = f", jitter up to {self.jitter_ms:g} ms" if self.jitter_ms else ""
        return f"{self.delay_ms:g} ms one way{jitter}, {100 * self.loss:g} % loss, {self.tcp}"


@contextmanager
def long_link(here: str, there: str, number: int, far: Far) -> Iterator[str]:
    """Link ``number`` between two machines; the address of ``here``.

    Raises:
        OSError: it cannot be made.
    """
    with Processes() as processes:
        pipe = processes.start(_carry, here, there, number, far)
        answer(pipe, PATIENCE_S)
        device = _device(number)
        for end, place in enumerate((here, there), 1):
            own, other = f"10.78.{number}.{end}", f"10.78.{number}.{3 - end}"
            run("ip", "-n", place, "addr", "add", own, "peer", other, "dev", device)
            run("ip", "-n", place, "link", "set", device, "up", "txqueuelen", "10000")
            run("ip", "-n", place, "route", "replace", other, "dev", device, "src", own, "congctl", far.tcp)
        try:
            yield f"10.78.{number}.1"
        finally:
            pipe.send("enough")
            late_ms, dropped = answer(pipe, PATIENCE_S)
            print(f"    the link itself was up to {late_ms:.1f} ms late, and dropped {dropped} packets besides")


def _device(number: int) -> str:
    return f"far{number}"


def _carry(pipe: Connection, here: str, there: str, number: int, far: Far) -> None:
    """Process of a link."""
    if may_use_fifo():
        use_fifo(20)  # a link waits for no processor
    fds = []
    for place in (here, there):
        enter(place)
        fd = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        fcntl.ioctl(fd, _TUNSETIFF, struct.pack("16sH22x", _device(number).encode(), _IFF_TUN | _IFF_NO_PI))
        fds.append(fd)
    pipe.send("ready")
    generator = random.Random(1)
    others = dict(zip(fds, reversed(fds), strict=True))
    last_s = dict.fromkeys(fds, 0.0)
    waiting: list[tuple[float, int, int, bytes]] = []
    count = dropped = 0
    late_s = 0.0
    epoll = select.epoll()
    for fd in (*fds, pipe.fileno()):
        epoll.register(fd, select.EPOLLIN)
    while True:
        left_s = waiting[0][0] - time.monotonic() if waiting else 1.0
        ready = epoll.poll(max(0.0, left_s - 0.0005)) if left_s > 0 else epoll.poll(0)
        for fd, _ in ready:
            if fd == pipe.fileno():
                pipe.send((1e3 * late_s, dropped))
                return
            while (packet := _read(fd)) is not None:
                if generator.random() < far.loss:
                    continue
                due_s = time.monotonic() + (far.delay_ms + far.jitter_ms * generator.random()) / 1e3
                last_s[fd] = due_s = max(due_s, last_s[fd])
                count += 1
                heapq.heappush(waiting, (due_s, count, others[fd], packet))
        while waiting and waiting[0][0] <= time.monotonic():
            due_s, _, fd, packet = heapq.heappop(waiting)
            late_s = max(late_s, time.monotonic() - due_s)
            try:
                os.write(fd, packet)
            except OSError:  # the other end is not up yet, or not any more
                dropped += 1


def _read(fd: int) -> bytes | None:
    try:
        return os.read(fd, _PACKET)
    except BlockingIOError:
        return None
