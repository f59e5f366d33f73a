"""A stream over a network as a bus: what TCP and UDP have in common."""

from __future__ import annotations

from typing import ClassVar

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
        """As a user writes it."""
        return f"bus {self.scheme}://{self.channel}"

    @property
    def baudrate(self) -> int:
        """0: a network has none."""
        return 0


__all__ = ["NetworkBus"]
