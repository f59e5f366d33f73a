"""A robot's YARP as sockets that say what a test wants: the name server, and the port."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LOCAL = "127.0.0.1"
PORT = "/icub/skin/left_hand_comp"
END = b"*** end of message\r\n"
GREETING = bytes.fromhex("5941641e0000525009000000") + b"skinware\0"
READING = GREETING + bytes.fromhex("59410a00000052500101ffffffffffffffff0800000000000000000000007e720001")
"""What a reader says to a port, as real ports of YARP 3.8.1 and 4.0.0 took it."""
PATIENCE_S = 20.0


class Answering:
    """Waits to be called, and has each caller handled in a thread.

    Attributes:
        port: at which.
        callers: sockets of all who called.
    """

    def __init__(self, handle: Callable[[socket.socket], None], port: int = 0) -> None:
        self._listener = socket.create_server((LOCAL, port))
        self.port: int = self._listener.getsockname()[1]
        self.callers: list[socket.socket] = []
        self._handle = handle
        self._threads = [threading.Thread(target=self._answer, name="yarp peer")]
        self._threads[0].start()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._threads[0].join(PATIENCE_S)  # from here on nobody calls
        self.hang_up()
        for thread in self._threads[1:]:
            thread.join(PATIENCE_S)

    def hang_up(self) -> None:
        """On everybody."""
        for caller in self.callers:
            with contextlib.suppress(OSError):
                caller.shutdown(socket.SHUT_RDWR)

    def _answer(self) -> None:
        while True:
            try:
                caller, _ = self._listener.accept()
            except OSError:
                return
            caller.settimeout(PATIENCE_S)
            self.callers.append(caller)
            thread = threading.Thread(target=self._converse, args=(caller,), name="yarp peer")
            self._threads.append(thread)
            thread.start()

    def _converse(self, caller: socket.socket) -> None:
        with contextlib.suppress(OSError), caller:
            self._handle(caller)


class Robot:
    """A name server that knows ``ports``, and one port that says ``says`` to each reader.

    Attributes:
        ports: where ports are, by name: (host, port, carrier).
        asked: everything that was said to the name server.
        heard: everything that was said to the port.
        is_dead: the port was read as one that kills its program.
    """

    def __init__(self, says: Callable[[socket.socket], None]) -> None:
        self.asked: list[bytes] = []
        self.heard: list[bytes] = []
        self.is_dead = False
        self._says = says
        self.port = Answering(self._speak)
        self.ports: dict[str, tuple[str, int, str]] = {PORT: (LOCAL, self.port.port, "tcp")}
        self.server = Answering(self._name)

    @property
    def bus(self) -> str:
        return f"yarp://{LOCAL}:{self.server.port}{PORT}"

    def close(self) -> None:
        self.server.close()
        self.port.close()

    def restart_port(self) -> None:
        """The robot's program ends and begins: its port is another one now."""
        self.port.close()
        self.port = Answering(self._speak)
        self.ports[PORT] = (LOCAL, self.port.port, "tcp")

    def restart_server(self) -> None:
        """At the same place, knowing the same."""
        number = self.server.port
        self.server.close()
        self.server = Answering(self._name, number)

    def _name(self, caller: socket.socket) -> None:
        with caller.makefile("rb") as lines:
            who = next(lines)
            assert who.startswith(b"CONNECT ")
            caller.sendall(b"Welcome " + who[8:].strip() + b"\r\n")
            for begin in lines:
                assert begin.strip() == b"d"
                command = next(lines).strip()
                self.asked.append(command)
                what, name, *more = command.decode().split()
                if what == "register":
                    carrier, host, number = more
                    self.ports[name] = (LOCAL if host == "..." else host, int(number), carrier)
                elif what == "unregister":
                    self.ports.pop(name, None)
                known = self.ports.get(name)
                told = b""
                if what == "set":
                    key, *values = more
                    told = f"port {name} property {key} = {' '.join(sorted(values))}\r\n".encode()
                elif known is not None:
                    told = "registration name {} ip {} port {} type {}\r\n".format(name, *known).encode()
                caller.sendall(told + END)

    def _speak(self, caller: socket.socket) -> None:
        heard = b""
        while len(heard) < len(READING) and READING.startswith(heard):
            more = caller.recv(len(READING) - len(heard))
            if not more:
                return
            heard += more
            if heard == GREETING:
                caller.sendall(b"YA" + self.port.port.to_bytes(4, "little") + b"RP")
        self.heard.append(heard)
        if heard != READING:
            self.is_dead = True  # as a real port of vectors, of a reader in text
            self.port.hang_up()
            return
        self._says(caller)


@contextmanager
def robot(says: Callable[[socket.socket], None]) -> Iterator[Robot]:
    with contextlib.closing(Robot(says)) as one:
        yield one


def until_gone(caller: socket.socket) -> None:
    """Wait until the reader goes, hearing whatever it says."""
    with contextlib.suppress(OSError):
        while caller.recv(100):
            pass


def message(data: bytes, command: bytes = b"\0\0\0\0~D\0\1") -> bytes:
    """A binary message of YARP in two blocks."""
    return b"YA\n\0\0\0RP\2\1" + b"\xff" * 8 + struct.pack("<iii", len(command), len(data), 0) + command + data


def vector(values: list[float], envelope: str = "") -> bytes:
    """As YARP 4 writes a vector of doubles."""
    data = struct.pack(f"<ii{len(values)}d", 276, len(values), *values)
    text = envelope.encode() + b"\0"
    return message(data, struct.pack("<i", len(text)) + b"~\0\0\1" + text) if envelope else message(data)
