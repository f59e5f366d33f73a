"""What Paxini's boards have in common for the driver: each is asked, started and attended to in its own way."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from skinware.geometry import Geometry
from skinware_drivers.description import Patch
from skinware_drivers.layout import Layout
from skinware_drivers.link import Link
from skinware_drivers.polling import Notice, Poll
from skinware_drivers.serial.framing import Framing


class Board(ABC):
    """One board on a line; the methods are those of a driver, see :class:`skinware_drivers.adapter.Adapter`.

    Attributes:
        framing: what it sends, as far as it is known yet.
        layout: what its frames mean; known once it was described.
        geometry: where its modules are, about; None: nobody knows.
        period_s: time between two updates.

    Args:
        period_s: time between two updates, as far as it is known yet.
        use: called with a framing: from now on it is that; what was received and is no whole frame is dropped.
        tell: called with what a patch says of itself.
    """

    framing: Framing
    layout: Layout
    geometry: Geometry | None = None

    def __init__(self, period_s: float, use: Callable[[Framing], None], tell: Callable[[Patch, Notice], None]) -> None:
        self.period_s = period_s
        self.use = use
        self.tell = tell

    @property
    def polls(self) -> Sequence[Poll]:
        """What it has to be asked; nothing if it sends by itself."""
        return ()

    @abstractmethod
    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask it what it has."""

    async def start(self, link: Link) -> None:  # noqa: B027  (one that is asked has nothing to do)
        """Have it send by itself, if it can."""

    async def stop(self, link: Link) -> None:  # noqa: B027
        """Make it silent."""

    @abstractmethod
    async def probe(self, link: Link, patch: Patch) -> bool:
        """Whether a silent patch answers, and is what it was."""

    @abstractmethod
    async def attend(self, link: Link) -> None:
        """Hear what is no data."""

    @abstractmethod
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:
        """Take the present forces as zero."""
