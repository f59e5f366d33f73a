"""Buses whose descriptors C can read."""

from __future__ import annotations

from abc import abstractmethod

from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.native.structs import Source


class KernelBus(Bus):
    """A bus of the kernel: a socket whose datagrams are ``struct can_frame`` or ``struct canfd_frame``, or a line."""

    @property
    @abstractmethod
    def reads_natively(self) -> bool:
        """Whether C can read the open bus in place of ``receive``."""

    @abstractmethod
    def hand_over(self, batch: FrameBatch, source: Source) -> bool:
        """Describe the bus to C, which then reads it in place of ``receive``.

        Args:
            batch: gets the frames.
            source: filled in: the descriptor, and the stream of a line; for a socket, the memory of ancillary data, the
                clocks and the counts so far.

        Returns:
            Whether C can read it now.
        """

    @abstractmethod
    def take_back(self, source: Source) -> None:
        """Take over what C counted since ``hand_over``; called before any other method."""

    def sort_out(self, batch: FrameBatch, new: slice) -> int:  # noqa: ARG002
        """Remove rows that are no data frames from new rows of a batch; return the number of rows that are left."""
        return len(range(new.start, new.stop))

    @abstractmethod
    def nothing_received(self, number: int) -> int:
        """Handle an error of the kernel in place of frames; 0: there were none although the socket was readable.

        Raises:
            skinware.errors.BusNotAvailable: the interface went down or away.
        """


def is_read_natively(bus: Bus) -> bool:
    """Return whether C can read a bus, as far as it is known."""
    return isinstance(bus, KernelBus) and bus.reads_natively
