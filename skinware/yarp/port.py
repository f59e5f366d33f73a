"""An output port of YARP: each reader gets the newest vector as fast as it can read, and none holds up another.

A reader connects and asks to read (the command ``r``), or makes the port connect to it (``yarp connect OURS ITS``: the
command ``[add]``). Commands come in text from ``yarp connect`` and in binary from ``yarp admin rpc``; the port knows
those of YARP's manual that it needs. All of it runs in one event loop.

YARP 3 and YARP 4 mark a list of doubles differently, and a connection does not show its version. Binary readers are
refused unless the user gives the version, so that none gets wrong numbers.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import socket
import struct
from dataclasses import dataclass, field

from skinware.yarp.carriers import (
    Carrier,
    Value,
    VectorMessage,
    YarpWord,
    framed,
    in_text,
    of_text,
    packed,
    unframed,
    unpacked,
)
from skinware.yarp.names import NameServer, PortAddress, is_port_name

log: logging.Logger = logging.getLogger("skinware.yarp")

_MOST_CONNECTIONS = 64
_LONGEST_LINE = 4096
_BEGIN = 8
_ANSWER = 8
_CONNECTING_S = 3.0
_GREETING_S = 10.0
_LONGEST_WHO = 80
_MOST_BEHIND = 1 << 16
"""Size of the send buffer, bytes: small, so that a slow reader gets no old vectors."""
_ADDRESS = re.compile(r"(?:(?P<carrier>[a-z_]+):/)?(?P<name>/.*)")
_INDEX = struct.Struct("<8sBB8x")
_COMMAND = struct.Struct("<icc2x")
_INDEX_NUMBER = 10
_MOST_BLOCKS = 16
_SENDS_ONLY = "this port only sends: yarp read reads it, yarp admin rpc asks it"
_WHICH_YARP = "YARP 3 and YARP 4 mark numbers differently: start skin-bridge yarp with --yarp 3 or --yarp 4"
_HELP = (
    "*       Gives a description of this port",
    "d       Signals the beginning of input for the port's owner, who takes none",
    "q       Disconnects",
    "r       Reverse connection type to be a reader",
    "/port   Requests to send output to /port",
    "!/port  Requests to stop sending output to /port",
    "a       Signals the beginning of an administrative message",
    "?       Gives this help",
)
_ADMINISTRATION = (
    "[add] PORT [CARRIER]: send to a port, by tcp, fast_tcp or text",
    "[del] PORT: send to it no more",
    "[list] [out] [PORT]: the ports that are sent to, or how one is",
    "[list] [in]: nothing, since this port only sends",
    "[ver]: version of these commands",
    "[help]: these lines",
)


@dataclass(eq=False)
class Receiver:
    """A reader; ``passed_over``: messages that it missed because it had not finished the one before."""

    name: str
    carrier: Carrier
    writer: asyncio.StreamWriter = field(repr=False)
    sent: int = 0
    passed_over: int = 0
    is_busy: bool = False

    def offer(self, message: VectorMessage) -> None:
        """Send a message, unless another is still on its way."""
        if self.is_busy or self.writer.transport.get_write_buffer_size():
            self.passed_over += 1
            return
        self.writer.write(message.of(self.carrier))
        self.is_busy = self.carrier.acknowledges
        self.sent += 1


class OutputPort:
    """An output port, for the event loop in which it is opened; ``yarp``: version of binary readers, 3 or 4."""

    def __init__(self, name: str, server: NameServer, yarp: int | None = None) -> None:
        self.name = name
        self._yarp = yarp
        self._number = 0
        self._has_warned = False
        self.receivers: list[Receiver] = []
        self._names = server
        self._server: asyncio.Server | None = None
        self._conversations: set[asyncio.Task[None]] = set()

    async def open(self, host: str) -> int:
        self._server = await asyncio.start_server(self._called, host, 0, limit=_LONGEST_LINE)
        self._number = self._server.sockets[0].getsockname()[1]
        return self._number

    def send(self, message: VectorMessage) -> None:
        for receiver in self.receivers:
            receiver.offer(message)

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        for task in list(self._conversations):
            task.cancel()
        await asyncio.gather(*self._conversations, return_exceptions=True)

    # -- incoming connections --------------------------------------------------------------------------------------

    async def _called(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is None:
            return
        self._conversations.add(task)
        try:
            if len(self._conversations) <= _MOST_CONNECTIONS:
                await self._converse(reader, writer)
        except (OSError, EOFError, ValueError, asyncio.CancelledError):
            pass  # it hung up, or sent something that is not YARP
        finally:
            self._conversations.discard(task)
            writer.close()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_GREETING_S):
            begin = await reader.readexactly(_BEGIN)
            carrier = Carrier.of_greeting(begin)
            if carrier is None:
                return
            if carrier.is_text:
                who = (await _line(reader))[:_LONGEST_WHO] or "?"
            else:
                who = await self._greeted_in_binary(reader, writer)
        if not carrier.is_text:
            await self._converse_in_binary(Receiver(who, carrier, writer), reader)
            return
        writer.write(f"Welcome {who}\r\n".encode())
        while True:
            await writer.drain()
            command = await _line(reader)
            if command == "q":
                return
            if command == "r":
                await self._serve(Receiver(who, carrier, writer), reader)
                return
            said = await self._obey(command, reader)
            writer.write("".join(f"{line}\r\n" for line in said).encode())
            if carrier.acknowledges:
                writer.write(b"<ACK>\r\n")

    async def _greeted_in_binary(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
        size = int.from_bytes(await reader.readexactly(4), "little")
        if not 1 <= size <= _LONGEST_LINE:
            raise ValueError(f"a name of {size} bytes")
        who = (await reader.readexactly(size))[:-1].decode("utf-8", "replace")
        writer.write(framed(self._number))
        await writer.drain()
        return who[:_LONGEST_WHO] or "?"

    async def _converse_in_binary(self, caller: Receiver, reader: asyncio.StreamReader) -> None:
        """Answer commands until the caller reads or goes; an answer is a list without the head of a message."""
        while True:
            command, data = await _binary_message(reader)
            if command == "r":
                if not self._refusal(caller.carrier, caller.name):
                    await self._serve(caller, reader)
                return
            answer = b""
            if command == "a":
                answer = packed(await self._administer([str(value) for value in unpacked(data)]))
            elif command[:1] == "d":  # D expects no answer
                answer = packed([YarpWord("fail"), _SENDS_ONLY])
            elif command.startswith(("/", "!/")):
                await self._obey(command, reader)
            caller.writer.write(answer + (framed(0) if caller.carrier.acknowledges else b""))
            await caller.writer.drain()
            if command == "q":
                return

    def _refusal(self, carrier: Carrier, who: str) -> str:
        """Return the reason why a carrier cannot be served; empty if it can."""
        if carrier.is_text or self._yarp is not None:
            return ""
        if not self._has_warned:
            self._has_warned = True
            log.warning("%s: %s reads by %s and is refused: %s", self.name, who, carrier.title, _WHICH_YARP)
        return _WHICH_YARP

    async def _obey(self, command: str, reader: asyncio.StreamReader) -> list[str]:
        if command[:1] in ("d", "D"):
            await _line(reader)  # data, which are ignored
            return []
        if command == "a":
            return [in_text(await self._administer(of_text(await _line(reader))))]
        if command == "*":
            lines = [
                f"There is an output connection from {self.name} to {r.name} using {r.carrier.title}"
                for r in self.receivers
            ]
            return [f"This is {self.name}", *(lines or ["There are no outgoing connections"])]
        if command in ("?", "h"):
            return ["This is a YARP port.  Here are the commands it responds to:", *_HELP]
        if command.startswith("/"):
            return [await self._add(command)]
        if command.startswith("!/"):
            return [self._remove(command[1:])]
        return ["Port command not understood.", "Type ? for help."]

    async def _administer(self, words: list[str]) -> list[Value]:
        match words:
            case ["ver", *_]:
                return [YarpWord("ver"), 1, 2, 3]
            case ["help", *_]:
                return [YarpWord("many"), *_ADMINISTRATION]
            case ["list", "in", *_]:
                return []
            case ["list", "out"]:
                return [receiver.name for receiver in self.receivers]
            case ["list", "out", name, *_]:
                to = next((each for each in self.receivers if each.name == name), None)
                if to is None:
                    return []
                ways: list[Value] = [["from", self.name], ["to", name], ["carrier", to.carrier.title]]
                return [*ways, ["connectionless", 0], ["push", 1]]
            case ["add", name]:
                said = await self._add(name)
            case ["add", name, carrier, *_]:
                said = await self._add(f"{carrier}:/{name}")
            case ["del", name, *_]:
                said = self._remove(name)
            case _:
                return [YarpWord("fail"), "send [help] for list of valid commands"]
        return [0 if said.startswith(("Added", "Removed")) else -1, said]

    # -- outgoing connections --------------------------------------------------------------------------------------

    async def _add(self, text: str) -> str:
        """Connect to a port and serve it until it hangs up; return YARP's answer to the command."""
        match = _ADDRESS.fullmatch(text)
        name = match["name"] if match else text
        carrier = next((each for each in Carrier if match and each.title == (match["carrier"] or "tcp")), None)
        if match is None or not is_port_name(name):
            return f"Cannot connect to {text!r}: it is no name of a port".replace('"', "'")
        if carrier is None:
            return f"Cannot connect to {name} by {match['carrier']}: only text, tcp and fast_tcp"
        if why := self._refusal(carrier, name):
            return f"Cannot connect to {name}: {why}"
        self._remove(name)
        try:
            async with asyncio.timeout(_CONNECTING_S):
                contact = await asyncio.to_thread(self._names.query, name)
                if contact is None:
                    return f"Cannot connect to {name}: the name server does not know it"
                reader, receiver = await self._call(contact, carrier)
        except (OSError, EOFError) as error:
            number = getattr(error, "errno", None)
            why = os.strerror(number) if number else str(error) or "no answer"
            return f"Cannot connect to {name}: {why}".replace('"', "'")
        task = asyncio.create_task(self._serve_called(receiver, reader))
        self._conversations.add(task)
        task.add_done_callback(self._conversations.discard)
        return f"Added connection from {self.name} to {name}"

    async def _call(self, contact: PortAddress, carrier: Carrier) -> tuple[asyncio.StreamReader, Receiver]:
        reader, writer = await asyncio.open_connection(contact.host, contact.port, limit=_LONGEST_LINE)
        try:
            writer.write(carrier.greeting(self.name))
            if not carrier.is_text and unframed(await reader.readexactly(_ANSWER)) is None:
                raise OSError("the answer is not that of a port of YARP")
        except BaseException:
            writer.close()
            raise
        return reader, Receiver(contact.name, carrier, writer)

    async def _serve_called(self, receiver: Receiver, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(OSError, EOFError, ValueError):
            await self._serve(receiver, reader)

    def _remove(self, name: str) -> str:
        gone = [receiver for receiver in self.receivers if receiver.name == name]
        for receiver in gone:
            self.receivers.remove(receiver)
            receiver.writer.transport.abort()
        if gone:
            return f"Removed connection from {self.name} to {name}"
        return f"Could not find an outgoing connection to {name}"

    # -- readers ---------------------------------------------------------------------------------------------------

    async def _serve(self, receiver: Receiver, reader: asyncio.StreamReader) -> None:
        """Send vectors until the receiver hangs up; it can only acknowledge them."""
        connection = receiver.writer.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MOST_BEHIND)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.receivers.append(receiver)
        try:
            while True:
                if not receiver.carrier.acknowledges:
                    if not await reader.read(_LONGEST_LINE):
                        return
                elif receiver.carrier.is_text:
                    await _line(reader)
                elif (size := unframed(await reader.readexactly(_ANSWER))) is None or not 0 <= size <= _LONGEST_LINE:
                    return
                else:
                    await reader.readexactly(size)
                receiver.is_busy = False
        finally:
            receiver.writer.transport.abort()  # unread vectors are of no use
            if receiver in self.receivers:
                self.receivers.remove(receiver)


async def _line(reader: asyncio.StreamReader) -> str:
    line = await reader.readline()
    if not line.endswith(b"\n"):
        raise EOFError("hung up")
    return line.decode("utf-8", "replace").strip()


async def _binary_message(reader: asyncio.StreamReader) -> tuple[str, bytes]:
    """Return the next message in binary: its command, and the data after it."""
    begin, n_blocks, n_answers = _INDEX.unpack(await reader.readexactly(_INDEX.size))
    if unframed(begin) != _INDEX_NUMBER or n_blocks + n_answers > _MOST_BLOCKS:
        raise ValueError("no message of YARP")
    sizes = struct.unpack(f"<{n_blocks + n_answers}i", await reader.readexactly(4 * (n_blocks + n_answers)))
    if min(sizes, default=0) < 0 or not _COMMAND.size <= sum(sizes) <= _LONGEST_LINE:
        raise ValueError(f"a message of YARP of {sum(sizes)} bytes")
    data = await reader.readexactly(sum(sizes))
    size, mark, letter = _COMMAND.unpack_from(data)
    text, rest = data[_COMMAND.size : _COMMAND.size + size], data[_COMMAND.size + size :]
    if mark != b"~" or not 0 <= size <= len(data) - _COMMAND.size:
        raise ValueError("no command of YARP")
    return (text.rstrip(b"\0") if size else letter).decode("utf-8", "replace"), rest
