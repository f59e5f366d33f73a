"""What a driver says of its hardware. Subclass a transport's adapter (``can.adapter.CanAdapter``), declare, done."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, StructureError
from skinware.geometry import Geometry
from skinware.sensor_types import SensorType
from skinware_drivers.bus import Bus, kind_of_bus
from skinware_drivers.description import Patch, SkinTables, assemble
from skinware_drivers.layout import Layout
from skinware_drivers.layout_check import check_layout
from skinware_drivers.link import DEFAULT_PACE_PER_MS, Link
from skinware_drivers.options import HasOptions, NoOptions, OptionsT
from skinware_drivers.polling import Notice, Poll, Watch

_COMMAND_OPTIONS = (
    "bus capture config cpus driver geometry group help json latency listen_only name namespace publish realtime slots"
    " systemd verbose version wait"
)


class Adapter(HasOptions[OptionsT], ABC):
    """One bus of a driver: what is attached to it, what its frames mean, and how to start it.

    The brackets of the base class name its options: ``class ThumbDriver(CanAdapter[ThumbOptions])``, or
    ``CanAdapter[NoOptions]``.

    The runner makes one per bus and calls, in this order, ``describe``, ``configure``, ``start``; while data flows
    ``probe`` and ``revive`` for a patch that fell silent; and ``stop`` before the bus is closed. All are coroutines
    of one event loop: they must never block. Each may raise ``BusError`` (a device did not answer, the bus went
    down) or ``OSError``; the runner then logs it and tries again later. Anything else is a fault of the driver's
    code: the bus is set aside and tried again later, and if no other one is served, the driver ends.

    In listen-only mode only ``describe``, ``attend`` and ``join`` are called, and every send is refused.

    Operations that programs may call while it runs are marked with :func:`skinware_drivers.operations.operation`.

    An object of the class can set its own ``types``, ``dtype``, ``layout``, ``geometry`` and ``period_s``, in
    ``__init__`` or, for hardware that describes itself, in ``describe``. The types of all buses are joined, and the
    values of all buses have the smallest dtype that holds those of each.

    Attributes:
        medium: kind of bus: ``can``, ``serial`` or ``virtual``.
        elsewhere: classes with the same options for the same devices on other kinds of bus.
        Options: struct of the options, as named in the brackets; becomes command-line options and TOML keys.
        types: the sensor types, with this hardware's units and scales.
        dtype: dtype of the values.
        layout: what frames mean.
        patches: what is attached to each bus, unless ``describe`` finds out.
        geometry: where their sensors are, by the uids that they have on their bus; None: nobody knows. What the bus
            knows, or a person gives, comes first. For hands: :mod:`skinware_drivers.hand`.
        period_s: nominal time between two updates of a module, 0.02 unless the class says another; an option
            ``period_ms`` sets it. Ages and silence are judged by it.
        by_cycle: publish when every live patch has delivered (True), or at the rate of ``period_s``.
        pace_per_ms: frames that may be sent within a millisecond on average; eight at once.
        heard_by: receives the notices of ``tell``; the runner sets it.
    """

    options_command = "skin-driver"
    reserved_options = frozenset(_COMMAND_OPTIONS.split())
    medium: ClassVar[str]
    elsewhere: ClassVar[Sequence[type[AnyAdapter]]] = ()
    Options: ClassVar[type[msgspec.Struct]] = NoOptions
    types: Sequence[SensorType] = ()
    dtype: npt.DTypeLike = np.uint8
    layout: Layout
    patches: Sequence[Patch] = ()
    geometry: Geometry | None = None
    by_cycle: bool = True
    pace_per_ms: float = DEFAULT_PACE_PER_MS
    heard_by: Callable[[Patch, Notice], None] | None = None

    @property
    def polls(self) -> Sequence[Poll]:
        """Requests to devices that only answer, sent repeatedly from ``start`` to ``stop``; called before each one."""
        return ()

    @property
    def payload_size(self) -> int:
        """Longest payload that a bus must be able to receive. Override it if ``describe`` makes the layout."""
        return self.layout.payload_size

    def check(self) -> None:
        """Check early that the driver's declarations are complete, unless ``describe`` asks its devices for them.

        Raises:
            ConfigurationError: something is missing, or contradicts something else; the message says what.
        """
        name = type(self).__name__
        if not self.period_s > 0:
            raise ConfigurationError(f"{name}: period_s = {self.period_s!r}: give the seconds between two updates")
        if type(self).describe is not Adapter.describe:
            return
        for needed in ("types", "layout", "patches"):
            if not getattr(self, needed, None):
                raise ConfigurationError(f"{name} has no `{needed}`")
        try:
            tables = assemble([("bus", self.patches)], self.types, self.dtype)
        except (StructureError, TypeError, AttributeError) as error:  # the last two: one where a list belongs, or so
            raise ConfigurationError(f"{name}: `patches`, `types` and `dtype` make no skin: {error}") from None
        try:
            check_layout(self.layout, self.patches, tables, self.period_s)
        except ConfigurationError as error:
            raise ConfigurationError(f"{name}: {error}") from None

    def wire_s(self, poll: Poll) -> float:  # noqa: ARG002
        """How long question and answer of a poll take on the wire at least, s; 0 where that is not known."""
        return 0.0

    def fit(self, bus: Bus) -> None:
        """Prepare a bus that is not open yet for what this driver expects of it.

        Raises:
            ConfigurationError: it is another kind of bus.
        """
        if not bus.fits(self.medium):
            raise ConfigurationError(
                f"{bus.name} is {kind_of_bus(bus.medium)}; {type(self).__name__} needs"
                f" {kind_of_bus(self.medium)}{bus.instead(self.medium)}"
            )

    async def describe(self, link: Link) -> Sequence[Patch]:  # noqa: ARG002
        """The patches on this bus; by default the declared ones. None yet: the runner asks again, indefinitely."""
        return self.patches

    async def configure(self, link: Link) -> None:
        """Configure the devices."""

    async def start(self, link: Link) -> None:
        """Start the data stream."""

    async def stop(self, link: Link) -> None:
        """Stop the data stream, also if ``configure`` or ``start`` was interrupted. It has less than a second."""

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Ask a patch that sends no data whether it is there; called repeatedly while it is silent.

        By default no request is sent, since many devices answer none: it may have lost its power, and is revived.

        Returns:
            True if it answered: it has restarted, and ``revive`` is called next.

        Raises:
            HandshakeTimeout: it did not answer. That is the same as False.
        """
        await self.revive(link, patch)
        return False

    async def revive(self, link: Link, patch: Patch) -> None:  # noqa: ARG002
        """Set one patch up anew and start it; by default, whatever is on the bus, once for all that need it.

        To be overridden where patches can be set up one by one: as long as one patch is missing, the others are
        disturbed, after 1 s, 2 s, 4 s and so on, at last once a minute.
        """
        await self.configure(link)
        await self.start(link)

    async def attend(self, link: Link) -> None:
        """Runs beside the data from ``describe`` to the end: for devices that speak of their own state (``tell``).

        What belongs to no module can be heard with ``link.follow``. A ``BusError`` ends it, and it is called again.
        """

    def tell(self, patch: Patch, notice: Notice) -> None:
        """To be called, from any of the coroutines, with what a patch says of itself; before there is data in vain."""
        if self.heard_by is not None:
            self.heard_by(patch, notice)

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        """On request: the patches with what has appeared on the bus meanwhile added; by default describe again."""
        del known
        return await self.describe(link)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Ask who is there, without knowing anything of the bus, for ``skin-find --probe``. By default nobody is asked.

        Only what can do no harm to any device of this kind may be sent, whatever it is doing.

        Args:
            link: the bus.
            idle: nothing is sending: requests that would disturb a device which sends are harmless too.

        Returns:
            Who answered, in a few words for people; None if nobody did.

        Raises:
            BusError: it could not be asked; ``HandshakeTimeout``: nobody answered.
        """
        return None

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """What marks doubtful values; by default nothing does."""
        return Watch(tables)


AnyAdapter = Adapter[Any]
