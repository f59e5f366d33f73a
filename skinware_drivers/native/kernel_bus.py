"""Buses from whose descriptors C code can receive."""

from __future__ import annotations

from abc import abstractmethod

from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.native.structs import Source


class KernelBus(Bus):
    """A bus of the kernel: a socket whose datagrams are ``struct can_frame`` or ``struct canfd_frame``, or a line."""

    @property
    @abstractmethod
    def reads_natively(self) -> bool:
        """Whether C code can receive in place of ``receive`` while it is open."""

    @abstractmethod
    def hand_over(self, batch: FrameBatch, source: Source) -> bool:
        """Tell C code how to receive in place of ``receive``.

        Args:
            batch: into whose rows.
            source: told: the descriptor, and the stream of a line; of a socket, where ancillary data goes, what is
                known of the clocks and counted so far.

        Returns:
            Whether it can, now.
        """

    @abstractmethod
    def take_back(self, source: Source) -> None:
        """Go on with what C code did since ``hand_over``; called before anything else is."""

    def sort_out(self, batch: FrameBatch, new: slice) -> int:  # noqa: ARG002
        """Take what is no data frame of this layout out of new rows of a batch; returns how many are left."""
        return len(range(new.start, new.stop))

    @abstractmethod
    def nothing_received(self, number: int) -> int:
        """What an error of the kernel means in the place of frames; 0: it gave nothing though there was something.

        Raises:
            skinware.errors.BusNotAvailable: the interface went down or away.
        """


def is_read_natively(bus: Bus) -> bool:
    """Whether C code can receive from a bus, as far as it is known."""
    return isinstance(bus, KernelBus) and bus.reads_natively
