"""A stream of bytes over TCP as a bus, with the framings of serial lines.

A connection that the other end closes counts as lost, like an unplugged serial port, and is opened again with the same
pauses. The kernel asks the other end now and then whether it is still there, which shows a pulled plug.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from collections.abc import Callable
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from skinware.errors import BusNotAvailable
from skinware_drivers.bus import Bus
from skinware_drivers.serial.ports import DescriptorPort, Port
from skinware_drivers.streams.bus import Address, NetworkBus, reason_of, unknown_name

_CONNECTING_S = 5.0
_WAITING_CALLERS = 4


class TcpOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    patience_s: Annotated[
        int, Meta(ge=2, le=600, description="seconds without a sign of the other end until the connection is given up")
    ] = 5


class TcpPort(DescriptorPort):
    """A connection.

    Args:
        connection: stays the owner of the descriptor.
        patience_s: seconds without a sign of the other end until it is given up.
    """

    def __init__(self, name: str, connection: socket.socket, patience_s: int) -> None:
        super().__init__(name, connection)
        keep_alive(connection, patience_s)

    def gone(self, number: int) -> BusNotAvailable:
        """Return the meaning of an error of the system; 0: the other end has closed the connection."""
        why = os.strerror(number) if number else "closed by the other end"
        return BusNotAvailable(f"{self._name}: the connection is lost ({why})")


class ListeningPort(Port):
    """The device's end: accepts one caller at a time, and closes the connections of others.

    Bytes that are written without a caller are dropped, as on a serial line without a reader.

    Args:
        address: at which to listen; port 0: any that is free, which ``note`` shows.
        patience_s: seconds without a sign of the caller until it is given up.

    Attributes:
        caller: the connection; None: there is none.
    """

    def __init__(self, address: Address, patience_s: int) -> None:
        self._patience_s = patience_s
        family, numbers = address.resolve(socket.SOCK_STREAM)
        try:
            self._listener = socket.create_server(numbers, family=family, backlog=_WAITING_CALLERS)
        except OSError as error:
            raise BusNotAvailable(f"cannot listen on {address}: {reason_of(error)}") from None
        self._listener.setblocking(False)
        self._epoll = select.epoll()
        self._epoll.register(self._listener, select.EPOLLIN)
        self.caller: socket.socket | None = None
        self.address = Address(*self._listener.getsockname()[:2])
        self.note: str = f"listens on {self.address}"

    def fileno(self) -> int:
        return self._epoll.fileno()

    def read(self, size: int) -> bytes:
        self._answer_callers()
        if self.caller is None:
            return b""
        try:
            data = self.caller.recv(size)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def write(self, data: bytes) -> int:
        """Write as much as fits into the kernel's buffer."""
        if self.caller is None:
            return len(data)
        try:
            written = self.caller.send(data)
        except BlockingIOError:
            written = 0
        except OSError:
            self._hang_up()
            return len(data)
        more = select.EPOLLOUT if written < len(data) else 0
        self._epoll.modify(self.caller, select.EPOLLIN | more)  # makes the epoll's own descriptor readable
        return written

    def close(self) -> None:
        self._hang_up()
        self._epoll.close()
        self._listener.close()

    def _answer_callers(self) -> None:
        while True:
            try:
                caller, _ = self._listener.accept()
            except (BlockingIOError, ConnectionError):
                return
            if self.caller is not None and _has_gone(self.caller):
                self._hang_up()
            if self.caller is not None:
                caller.close()
                continue
            caller.setblocking(False)
            keep_alive(caller, self._patience_s)
            self._epoll.register(caller, select.EPOLLIN)
            self.caller = caller

    def _hang_up(self) -> None:
        if self.caller is not None:
            with contextlib.suppress(OSError):
                self._epoll.unregister(self.caller)
            self.caller.close()
            self.caller = None


class TcpServerBus(NetworkBus):
    """The device's end of a connection, for emulators: ``skin-emulate --bus tcp://HOST:PORT``.

    ``note`` shows where it listens.
    """

    scheme: ClassVar[str] = "tcp"
    options_class: ClassVar[type[msgspec.Struct]] = TcpOptions

    def _open_port(self) -> Port:
        return ListeningPort(self._place, self._options.patience_s)


class TcpBus(NetworkBus):
    """A connection to a device, or to a converter of serial lines. Its name is ``tcp://HOST:PORT?key=value``.

    An IPv6 address stands in brackets. The options are those of :class:`TcpOptions`.
    """

    scheme: ClassVar[str] = "tcp"
    options_class: ClassVar[type[msgspec.Struct]] = TcpOptions
    needs_host: ClassVar[bool] = True
    device_end: ClassVar[Callable[..., Bus] | None] = TcpServerBus

    def _open_port(self) -> Port:
        return TcpPort(f"tcp://{self._place}", connect(self._place), self._options.patience_s)


def connect(address: Address) -> socket.socket:
    """Connect to a device; blocks for seconds if it does not answer.

    Raises:
        BusNotAvailable: its name is not known, it does not answer, or nothing listens at that port.
    """
    where = f"tcp://{address}"
    try:
        connection = socket.create_connection(address, _CONNECTING_S)
    except socket.gaierror as error:
        raise unknown_name(address, error) from None
    except ConnectionRefusedError:
        raise BusNotAvailable(f"{where}: the host is there, but nothing listens at this port") from None
    except TimeoutError:
        raise BusNotAvailable(f"{where}: no answer within {_CONNECTING_S:g} s") from None
    except OSError as error:
        raise BusNotAvailable(f"{where}: {error.strerror or error}") from None
    if connection.getsockname() == connection.getpeername():  # the free local port that the kernel gave us
        connection.close()
        raise BusNotAvailable(f"{where}: nothing listens at this port")
    return connection


def keep_alive(connection: socket.socket, patience_s: int) -> None:
    """Send what is written at once, and let the kernel give up another end after a time without a sign of it."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, max(1, patience_s // 2))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, patience_s)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * patience_s)


def _has_gone(connection: socket.socket) -> bool:
    try:
        return not connection.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return False
    except OSError:
        return True
