"""What a hostile member of the namespace's group costs a periodic writer by its requests.

A writer publishes at 1 kHz, and somebody else in its group does his worst on its request socket. In the control rounds
he only computes, which takes as much of the machine. All kinds of attack take turns, for several rounds; the table has
the periods that the writer missed of 1,000 (median of the rounds, and the worst), and its longest turn at the requests,
in time and on a processor: what lies between the two, others took from it. Only root can be two users. With SCHED_FIFO
for the writer where that is allowed: otherwise the other users of the machine decide.
"""

from __future__ import annotations

import argparse
import codecs
import grp
import os
import socket
import statistics
import sys
import time
from collections import defaultdict
from multiprocessing.connection import Connection

from processes import Processes, answer, may_use_fifo, own_namespace

from skinware import Namespace, ServiceWriter
from skinware.realtime import now_ns
from skinware.service._server import short_path

GROUP, OWNER, MEMBER = "games", 61001, 61002
_MOST_MISSED = 1.0
_PEERS = 16


def ask(value: bytes) -> bytes:
    """A request of the operation that the writer has."""
    return b'{"id":1,"operation":"echo","arguments":{"value":' + value + b"}}"


def listed(item: bytes, size: int) -> bytes:
    """A JSON list of about so many bytes."""
    return b"[" + b",".join([item] * (size // (len(item) + 1))) + b"]"


PACKETS = {
    "small requests": ask(b"1"),
    "60 kB of lists": ask(listed(b"[]", 60_000)),
    "4 kB of numbers": ask(listed(b"2.2250738585072011e-308", 4000)),
    "4 kB with 126 lists": ask(listed(b"[1,1,1,1,1,1,1,1,1,1,1,1,1,1]", 3700)),
    "no request": b"\xff" * 60_000,
}
CONTROL, CONNECTIONS = "control: computes", "connections"


def own(pipe: Connection, namespace: Namespace, fifo: bool) -> None:
    """The writer; sends frames published, periods missed, and its longest turn: in time and on a processor, ns."""
    if fifo:  # and no locked memory, of which the next user may have little
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    become(OWNER)
    longest_ns = longest_cpu_ns = 0
    with ServiceWriter(
        "x", {"values": ("<u4", 100)}, namespace=namespace, group=GROUP, operations={"echo": lambda value: value}
    ) as writer:
        answer_requests = writer.answer_requests

        def timed(timeout_s: float = 0.0) -> list[object]:
            nonlocal longest_ns, longest_cpu_ns
            begin_ns, begin_cpu_ns = now_ns(), time.thread_time_ns()
            found: list[object] = list(answer_requests(timeout_s))
            longest_ns = max(longest_ns, now_ns() - begin_ns)
            longest_cpu_ns = max(longest_cpu_ns, time.thread_time_ns() - begin_cpu_ns)
            return found

        writer.answer_requests = timed  # type: ignore[method-assign, assignment]
        for columns in writer.periodic(1000):
            columns["values"][:] = writer.sequence
            if writer.sequence == 1:
                pipe.send("ready")
            if pipe.poll():
                break
        pipe.send((writer.sequence, writer.missed_periods, longest_ns, longest_cpu_ns))


def attack(pipe: Connection, namespace: Namespace, kind: str, seconds: float) -> None:
    """One member of the group; sends how often it did it."""
    become(MEMBER)
    path, end, done = namespace.socket_path("x"), time.monotonic() + seconds, 0
    peers: list[socket.socket] = []
    while time.monotonic() < end:
        done += 1
        if kind == CONTROL:
            continue
        if kind == CONNECTIONS or len(peers) < _PEERS:
            with short_path(path) as name:
                peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
                peer.setblocking(False)
                try:
                    peer.connect(name)
                except BlockingIOError:
                    peer.close()
                    continue
            if kind == CONNECTIONS:
                peer.close()
                continue
            peers.append(peer)
        peers = [peer for peer in peers if spoke(peer, PACKETS[kind])]
    for peer in peers:
        peer.close()
    pipe.send(done)


def spoke(peer: socket.socket, packet: bytes) -> bool:
    """Ask, and take the answer if there is one; whether the connection still holds."""
    for speak in (lambda: peer.send(packet), lambda: peer.recv(1 << 16)):
        try:
            if not speak():
                raise ConnectionResetError
        except BlockingIOError:
            pass
        except OSError:
            peer.close()
            return False
    return True


def become(user: int) -> None:
    """Be another user of the group from now on."""
    codecs.lookup("ascii")  # what Python loads late, from where that user may not look
    codecs.lookup("idna")
    os.setgroups([grp.getgrnam(GROUP).gr_gid])
    os.setgid(user)
    os.setuid(user)
    os.environ["SKINWARE_OWNER"] = str(OWNER)


def run(kind: str, seconds: float, fifo: bool) -> tuple[float, float, float]:
    """Periods missed of 1,000, and the longest turn: in time and on a processor, ms."""
    with own_namespace() as made, Processes() as processes:
        namespace = Namespace(made.name, owner=OWNER)
        writer = processes.start(own, namespace, fifo)
        answer(writer, 30)
        answer(processes.start(attack, namespace, kind, seconds), seconds + 30)
        writer.send("stop")
        published, missed, longest_ns, longest_cpu_ns = answer(writer, 30)
        return 1000 * missed / (published + missed), longest_ns / 1e6, longest_cpu_ns / 1e6


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0, help="of each attack (default: 4)")
    arguments = parser.parse_args()
    if os.geteuid() != 0:
        sys.exit("only root can be two users: sudo tools/bench hostile")
    fifo = may_use_fifo()
    rounds: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for _ in range(arguments.rounds):
        for kind in (CONTROL, CONNECTIONS, *PACKETS):
            rounds[kind].append(run(kind, arguments.seconds, fifo))
    print(f"writer at 1 kHz, {'SCHED_FIFO' if fifo else 'normal scheduling'}, {arguments.rounds} rounds")
    print("\n| a member of the group | missed of 1,000: median / worst | longest turn, ms | on a processor, ms |")
    print("|---|---|---|---|")
    typical = {}
    for kind, results in rounds.items():
        missed, longest_ms, longest_cpu_ms = zip(*results, strict=True)
        typical[kind] = statistics.median(missed)
        print(
            f"| {kind} | {typical[kind]:.2f} / {max(missed):.2f} | {max(longest_ms):.2f} | {max(longest_cpu_ms):.2f} |"
        )
    worst = max((kind for kind in typical if kind != CONTROL), key=lambda kind: typical[kind])
    cost = typical[worst] - typical[CONTROL]
    verdict = "met   " if cost <= _MOST_MISSED else "MISSED"
    print(f"\n{verdict} an attack costs at most {_MOST_MISSED:g} period of 1,000: {cost:+.2f} ({worst})")


if __name__ == "__main__":
    main()
