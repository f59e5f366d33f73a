"""An output port of YARP: whoever reads it gets the newest vector, as fast as each can; nobody is waited for.

A reader calls us and asks to read (the command ``r``, in text or binary), or has us call it (``yarp connect OURS ITS``,
which is the command ``[add]`` to a port). Commands are taken in text, as YARP's own tools send them; they are those of
its manual that a port cannot do without. All of it runs in one event loop.

YARP 3 and YARP 4 mark a list of doubles differently, and a connection does not show which of them reads. Where the user
has not named the version, binary readers are refused: none gets wrong numbers.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import socket
from dataclasses import dataclass, field

from skinware.yarp.carriers import READ, Carrier, Message, framed, unframed
from skinware.yarp.names import Contact, NameServer, is_port_name

log: logging.Logger = logging.getLogger("skinware.yarp")

_MOST_CONNECTIONS = 64
_LONGEST_LINE = 4096
_BEGIN = 8
_ANSWER = 8
_CONNECTING_S = 3.0
_GREETING_S = 10.0
_LONGEST_WHO = 80
_MOST_BEHIND = 1 << 16
"""Wanted of the kernel: bytes that may be on their way to a reader, so that what a slow one sees is not old."""
_ADDRESS = re.compile(r"(?:(?P<carrier>[a-z_]+):/)?(?P<name>/.*)")
_WORD = re.compile(r'"([^"]*)"|\(([^()]*)\)|(\S+)')
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


@dataclass(eq=False)
class Receiver:
    """Somebody who reads.

    Attributes:
        name: as it calls itself, or of its port.
        carrier: of the connection.
        sent: messages that it was sent.
        passed_over: messages that it did not get as it was not done with the one before.
    """

    name: str
    carrier: Carrier
    writer: asyncio.StreamWriter = field(repr=False)
    sent: int = 0
    passed_over: int = 0
    is_busy: bool = False

    def offer(self, message: Message) -> None:
        """Send it, unless there is still something on its way."""
        if self.is_busy or self.writer.transport.get_write_buffer_size():
            self.passed_over += 1
            return
        self.writer.write(message.of(self.carrier))
        self.is_busy = self.carrier.acknowledges
        self.sent += 1


class OutputPort:
    """A port that is read; to be used in the event loop that :meth:`open` was called in.

    Args:
        name: of the port.
        server: asked for the ports that it is to call.
        yarp: major version of the YARP that reads in binary, 3 or 4; None: not known.
    """

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
        """Listen, at any port that is free; gives which.

        Raises:
            OSError: it cannot listen there.
        """
        self._server = await asyncio.start_server(self._called, host, 0, limit=_LONGEST_LINE)
        self._number = self._server.sockets[0].getsockname()[1]
        return self._number

    def send(self, message: Message) -> None:
        """To all who read, as far as each can take it now; never waits."""
        for receiver in self.receivers:
            receiver.offer(message)

    async def close(self) -> None:
        """Hang up on everybody, and listen no more."""
        if self._server is not None:
            self._server.close()
        for task in list(self._conversations):
            task.cancel()
        await asyncio.gather(*self._conversations, return_exceptions=True)

    # -- who calls -------------------------------------------------------------------------------------------------

    async def _called(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is None:
            return
        self._conversations.add(task)
        try:
            if len(self._conversations) <= _MOST_CONNECTIONS:
                await self._converse(reader, writer)
        except (OSError, EOFError, ValueError, asyncio.CancelledError):
            pass  # it hung up, or says what no line of YARP's is
        finally:
            self._conversations.discard(task)
            writer.close()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(_GREETING_S):
            begin = await reader.readexactly(_BEGIN)
            carrier = Carrier.of_greeting(begin)
            if carrier is None:
                return
            if not carrier.is_text:
                who = await self._asked_to_send(reader, writer)
                if who and not self._refusal(carrier, who):
                    await self._serve(Receiver(who, carrier, writer), reader)
                return
            who = (await _line(reader))[:_LONGEST_WHO] or "?"
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

    async def _asked_to_send(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> str:
        """Greet a caller in binary; gives its name if it asks to read, else nothing."""
        size = int.from_bytes(await reader.readexactly(4), "little")
        if not 1 <= size <= _LONGEST_LINE:
            return ""
        who = (await reader.readexactly(size))[:-1].decode("utf-8", "replace")
        writer.write(framed(self._number))
        await writer.drain()
        return who[:_LONGEST_WHO] or "?" if await reader.readexactly(len(READ)) == READ else ""

    def _refusal(self, carrier: Carrier, who: str) -> str:
        """Why a reader cannot be served in a carrier; empty if it can."""
        if carrier.is_text or self._yarp is not None:
            return ""
        if not self._has_warned:
            self._has_warned = True
            log.warning("%s: %s reads by %s and is refused: %s", self.name, who, carrier.title, _WHICH_YARP)
        return _WHICH_YARP

    async def _obey(self, command: str, reader: asyncio.StreamReader) -> list[str]:
        """What a command says back."""
        if command[:1] in ("d", "D"):
            await _line(reader)  # data, of which we take none
            return []
        if command == "a":
            return [await self._administer(_words(await _line(reader)))]
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

    async def _administer(self, words: list[str]) -> str:
        """What an administrative message is answered with, as a list in text."""
        match words:
            case ["ver", *_]:
                return "ver 1 2 3"
            case ["list", "in", *_]:
                return ""
            case ["list", "out"]:
                return " ".join(receiver.name for receiver in self.receivers)
            case ["list", "out", name, *_]:
                return next((self._described(each) for each in self.receivers if each.name == name), "")
            case ["add", name]:
                said = await self._add(name)
            case ["add", name, carrier, *_]:
                said = await self._add(f"{carrier}:/{name}")
            case ["del", name, *_]:
                said = self._remove(name)
            case _:
                return '[fail] "send [help] for list of valid commands"'
        return f'{0 if said.startswith(("Added", "Removed")) else -1} "{said}"'

    def _described(self, receiver: Receiver) -> str:
        return f"(from {self.name}) (to {receiver.name}) (carrier {receiver.carrier.title}) (connectionless 0) (push 1)"

    # -- whom we call ----------------------------------------------------------------------------------------------

    async def _add(self, text: str) -> str:
        """Call a port, and serve it until it hangs up; gives what YARP says of that."""
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

    async def _call(self, contact: Contact, carrier: Carrier) -> tuple[asyncio.StreamReader, Receiver]:
        reader, writer = await asyncio.open_connection(contact.host, contact.port, limit=_LONGEST_LINE)
        try:
            writer.write(carrier.greeting(self.name))
            if not carrier.is_text and unframed(await reader.readexactly(_ANSWER)) is None:
                raise OSError("what answers there is no port of YARP")
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
        return (
            f"Removed connection from {self.name} to {name}"
            if gone
            else f"Could not find an outgoing connection to {name}"
        )

    # -- who reads -------------------------------------------------------------------------------------------------

    async def _serve(self, receiver: Receiver, reader: asyncio.StreamReader) -> None:
        """Send vectors until the receiver hangs up; all it can say is that it has got one."""
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
            receiver.writer.transport.abort()  # what it has not read yet is for nobody
            if receiver in self.receivers:
                self.receivers.remove(receiver)


async def _line(reader: asyncio.StreamReader) -> str:
    """The next line.

    Raises:
        EOFError: there is none any more.
        ValueError: it is too long.
    """
    line = await reader.readline()
    if not line.endswith(b"\n"):
        raise EOFError("hung up")
    return line.decode("utf-8", "replace").strip()


def _words(text: str) -> list[str]:
    """A flat list in text, whose words may stand in quotes or, as commands do, in square brackets."""
    words = ["".join(found) for found in _WORD.findall(text)]
    return [word[1:-1] if word.startswith("[") and word.endswith("]") else word for word in words]


__all__ = ["OutputPort", "Receiver"]
