"""A stream over a network as a bus: what TCP and UDP have in common, and what servers that are only read have."""

from __future__ import annotations

from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from skinware.errors import BusNotAvailable, BusSendError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.streams.address import Address, parse_address


class NetworkBus(SerialBus):
    """A serial bus that is reached over a network.

    Args:
        channel: ``HOST:PORT``.
        payload_size: longest body that fits into a batch.
        listen_only: refuse every ``send``.

    Raises:
        ConfigurationError: no such address.
    """

    scheme: ClassVar[str]
    needs_host: ClassVar[bool] = False

    def __init__(self, channel: str, *, payload_size: int, listen_only: bool) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._address: Address = parse_address(self.scheme, channel, needs_host=self.needs_host)

    @property
    def name(self) -> str:
        return f"bus {self.scheme}://{self.channel}"

    @property
    def baudrate(self) -> int:
        """0: a network has none."""
        return 0


class ServerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a bus that is a connection to a program that sends by itself."""

    patience_s: Annotated[
        int, Meta(ge=2, le=600, description="seconds without a sign of the other end until the connection is given up")
    ] = 5
    silence_s: Annotated[
        float, Meta(ge=0, le=3600, description="seconds without a message until it is connected anew; 0: never")
    ] = 5.0


class ServerBus(SerialBus):
    """A program that sends by itself, perhaps to others as well, and is only read.

    Args:
        channel: what the bus' name has after the interface.
        options: see :class:`ServerOptions`.
        payload_size: longest body that fits into a batch.
        listen_only: makes no difference: nothing is ever sent.

    Raises:
        ConfigurationError: an option is unknown or has a bad value.
    """

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._options = options_from_strings(ServerOptions, options or {})
        self._heard_ns = 0

    @property
    def baudrate(self) -> int:
        """0: a network has none."""
        return 0

    @property
    def reads_natively(self) -> bool:
        """No: the protocol is spoken in Python."""
        return False

    def open(self) -> None:
        """Connect.

        Raises:
            BusNotAvailable: nobody answers there, or somebody else does.
        """
        super().open()
        self._heard_ns = now_ns()

    def check(self) -> None:
        """Whether the other end still says something.

        Raises:
            BusNotAvailable: it has not for too long.
        """
        super().check()
        silence_s = self._options.silence_s
        if self._port is not None and silence_s and now_ns() - self._heard_ns > silence_s * NS_PER_S:
            raise BusNotAvailable(f"{self.name}: connected, but no message for {silence_s:g} s; connecting anew")

    def send(self, identifier: int, payload: bytes) -> None:
        """Refuse: it is only read.

        Raises:
            BusSendError: always.
        """
        self.counters.send_failures += 1
        raise BusSendError(f"{self.name} is only read ({identifier:#x}, {len(payload)} bytes)")

    def _hear(self, chunk: bytes, time_ns: int) -> None:
        self._heard_ns = time_ns
        super()._hear(chunk, time_ns)
