"""Describe hardware: a driver subclasses the adapter of its transport, such as ``skinware_drivers.can.CanAdapter``."""

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
from skinware_drivers.decoding.addresses import Addresses
from skinware_drivers.description import Patch, SkinTables, assemble
from skinware_drivers.fields import Packed
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from skinware_drivers.link import DEFAULT_PACE_PER_MS, Link
from skinware_drivers.native.compiling import check_values
from skinware_drivers.options import HasOptions, NoOptions, OptionsT
from skinware_drivers.polling import Notice, Poll, Watch

_COMMAND_OPTIONS = (
    "bus capture config cpus driver geometry group help json latency listen_only name namespace publish realtime slots"
    " systemd verbose version wait"
)


class Adapter(HasOptions[OptionsT], ABC):
    """A driver on one bus: the devices attached to it, the meaning of their frames, and how to start them.

    The brackets of the base class name the options: ``class ThumbDriver(CanAdapter[ThumbOptions])``, or
    ``CanAdapter[NoOptions]``.

    The runner makes one object per bus and calls ``describe``, ``configure`` and ``start``; while data flows, ``probe``
    and ``revive`` for a patch that fell silent; and ``stop`` before it closes the bus. All are coroutines of one event
    loop: they must never block. If one raises ``BusError`` (a device did not answer, the bus went down) or ``OSError``,
    the runner logs it and tries again. Anything else is a fault in the driver's code: the bus is set aside and tried
    again later, and if no other bus is served, the driver ends.

    In listen-only mode only ``describe``, ``attend`` and ``join`` are called, and every send is refused.

    Operations that programs may call are marked with :func:`skinware_drivers.operations.operation`.

    An object can set its own ``types``, ``dtype``, ``layout``, ``geometry`` and ``period_s``, in ``__init__`` or, for
    hardware that describes itself, in ``describe``. The types of all buses are joined, and the values of all buses
    have the smallest dtype that holds those of each.

    Attributes:
        medium: kind of bus: ``can``, ``serial``, ``modbus`` or ``virtual``.
        elsewhere: classes with the same options for the same devices on other kinds of bus.
        Options: struct of the options, as named in the brackets; its fields become command-line options and TOML keys.
        types: the sensor types, with this hardware's units and scales.
        patches: the patches on each bus, unless ``describe`` finds them.
        geometry: positions of the sensors, by their uids on the bus; None: unknown. A geometry of the bus or of a
            person takes its place. For hands: :mod:`skinware_drivers.hand`.
        period_s: nominal time between two updates of a module, 0.02 by default; an option ``period_ms`` sets it. Ages
            and silence are judged by it.
        by_cycle: publish when every live update group has arrived, or after a short wait (True); False: at the rate
            of ``period_s``.
        pace_per_ms: frames that may be sent within a millisecond on average; eight at once.
        heard_by: receives the notices of this driver; the runner sets it.
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
        """Requests to devices that only answer, repeated from ``start`` to ``stop``; read before each request."""
        return ()

    @property
    def payload_size(self) -> int:
        """Longest payload that a bus must be able to receive, bytes. Override it if ``describe`` makes the layout."""
        return self.layout.payload_size

    def check(self) -> None:
        """Check that the declarations are complete, unless ``describe`` asks the devices for them.

        Raises:
            ConfigurationError: a declaration is missing, or contradicts another; the message names it.
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
        except (StructureError, TypeError, AttributeError) as error:  # the last two: one object in place of a list
            raise ConfigurationError(f"{name}: `patches`, `types` and `dtype` make no skin: {error}") from None
        try:
            check_layout(self.layout, self.patches, tables, self.period_s)
        except ConfigurationError as error:
            raise ConfigurationError(f"{name}: {error}") from None

    def wire_s(self, poll: Poll) -> float:  # noqa: ARG002
        """Return the least time that question and answer of a poll take on the wire, s; 0 if it is not known."""
        return 0.0

    def fit(self, bus: Bus) -> None:
        """Prepare a bus, which is not open yet, for this driver.

        Raises:
            ConfigurationError: it is another kind of bus.
        """
        if not bus.fits(self.medium):
            raise ConfigurationError(
                f"{bus.name} is {kind_of_bus(bus.medium)}; {type(self).__name__} needs"
                f" {kind_of_bus(self.medium)}{bus.instead(self.medium)}"
            )

    async def describe(self, link: Link) -> Sequence[Patch]:  # noqa: ARG002
        """Return the patches on this bus, by default the declared ones; if there are none, the runner asks again."""
        return self.patches

    async def configure(self, link: Link) -> None:
        """Configure the devices."""

    async def start(self, link: Link) -> None:
        """Start the data stream."""

    async def stop(self, link: Link) -> None:
        """Stop the data stream, also if ``configure`` or ``start`` was interrupted. It has less than a second."""

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Ask a silent patch whether it is there; called repeatedly while it is silent.

        By default it is not asked, since many devices answer no request, but revived, in case it lost its power.

        Returns:
            True: the patch answered. It has restarted, and ``revive`` is called next.

        Raises:
            HandshakeTimeout: the patch did not answer, which is the same as False.
        """
        await self.revive(link, patch)
        return False

    async def revive(self, link: Link, patch: Patch) -> None:  # noqa: ARG002
        """Set one patch up again and start it; by default all patches of the bus.

        Override it if patches can be set up one by one. Otherwise each attempt to revive a missing patch interrupts the
        others: after 1 s, 2 s, 4 s and so on, at last once a minute.
        """
        await self.configure(link)
        await self.start(link)

    async def attend(self, link: Link) -> None:
        """Listen to devices that report their own state, from ``describe`` to the end; pass it on as a notice.

        ``link.follow`` returns frames that belong to no module. After a ``BusError``, ``attend`` is called again.
        """

    def tell(self, patch: Patch, notice: Notice) -> None:
        """Report what a patch says about itself; it has no effect before there is data. Call it in any coroutine."""
        if self.heard_by is not None:
            self.heard_by(patch, notice)

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        """Return the known patches and those that have appeared on the bus since; by default, describe again."""
        del known
        return await self.describe(link)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Ask an unknown bus for devices of this kind, for ``skin-find --probe``; by default send nothing.

        Send only requests that do no harm to any device of this kind, whatever it is doing.

        Args:
            idle: no device is sending, so requests that disturb a sending device are harmless, too.

        Returns:
            The device that answered, in a few words for people; None: no device did.

        Raises:
            BusError: the request could not be sent.
            HandshakeTimeout: no device answered.
        """
        return None

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """Return the object that marks doubtful values; by default it marks none."""
        return Watch(tables)


AnyAdapter = Adapter[Any]


class VirtualAdapter(Adapter[OptionsT]):
    """One bus of a skin whose values a program makes, ``--bus virtual``.

    There is no wire: payloads can have any length that the layout declares.
    """

    medium: ClassVar[str] = "virtual"


_DTYPES = ("u1", "i2", "u2", "i4", "f4")
"""Dtypes that a driver can have, the smallest first."""


def check_layout(layout: Layout, patches: Sequence[Patch], tables: SkinTables, period_s: float) -> None:
    """Refuse a layout under which values would be cut or dropped, or halves of two cycles be joined.

    Args:
        period_s: nominal time between two updates of a module.

    Raises:
        ConfigurationError: it does not fit; the message says how to change it.
    """
    for cycle in layout.cycles:
        _check_age(cycle, cycle.period_s or period_s)
        writer: dict[int, str] = {}
        for frame in [frame for frame in layout.frames if frame.name in cycle.members]:
            for channel in {c for values in frame.runs for c in values.channels if c is not None}:
                other = writer.setdefault(channel, frame.name)
                if other != frame.name:
                    raise ConfigurationError(
                        f"frames {other!r} and {frame.name!r} of a cycle both have a value for channel {channel}: a"
                        " value lies in one frame, give each frame channels of its own (`to`)"
                    )
    n_channels = [len(module.channels) for patch in patches for module in patch.modules]
    names = [patch.name for patch in patches for _ in patch.modules]
    addresses = Addresses(layout.frames, [range(len(layout.frames))], tables)
    for number, frame in enumerate(layout.frames):
        check_values(frame)
        for values in frame.runs:
            _check_dtype(frame, values, tables.structure.dtype)
        needed = 1 + max((c for values in frame.runs for c in values.channels if c is not None), default=-1)
        for module in addresses.modules_of(number, frame):
            if needed > n_channels[module]:
                raise ConfigurationError(
                    f"frame {frame.name!r} has a value for channel {needed - 1}, and a module of {names[module]!r} has"
                    f" {n_channels[module]} channels, from 0: give it more, say with `to` which values are dropped"
                    " (None), or give that module a key that the identifier of this frame cannot have"
                )


def _check_age(cycle: Cycle, period_s: float) -> None:
    if cycle.reach_s < cycle.turn * period_s:
        return
    fits = f"`period_s` is {period_s:g} s" + (f", its counter has {cycle.turn} values" if cycle.turn > 1 else "")
    most = "half of that" if cycle.order == "any" else "that"
    raise ConfigurationError(
        f"cycle of {', '.join(cycle.members)}: two cycles fit into maximum_age_s = {cycle.maximum_age_s:g}, and their"
        f" frames could not be distinguished ({fits}): make it shorter than {most}, say half as long"
        + ("" if cycle.turn > 1 else "; or say where its frames have a `counter`")
    )


def _check_dtype(frame: Frame, values: Values, dtype: np.dtype[np.generic]) -> None:
    if all(channel is None for channel in values.channels) or _holds(dtype, values.dtype):
        return
    sent = f"{values.dtype.bits} bits" if isinstance(values.dtype, Packed) else f"dtype {values.dtype!r}"
    wide = next((name for name in _DTYPES if _holds(np.dtype(name), values.dtype)), None)
    hint = f"; give it `dtype` = {np.dtype(wide).name}" if wide else ""
    raise ConfigurationError(f"frame {frame.name!r}: values of {sent} do not fit the driver's dtype {dtype.name}{hint}")


def _holds(dtype: np.dtype[np.generic], sent: str | Packed) -> bool:
    """Return whether the dtype has every value that can be sent (float32: at least nearly)."""
    if not isinstance(sent, Packed) and np.dtype(sent).kind not in "iu":
        return np.can_cast(sent, dtype, "safe")
    if dtype.kind == "f":
        return True
    if isinstance(sent, Packed):
        bits = sent.bits - sent.signed
        least, most = -(1 << bits) if sent.signed else 0, (1 << bits) - 1
    else:
        least, most = int(np.iinfo(np.dtype(sent).name).min), int(np.iinfo(np.dtype(sent).name).max)
    limits = np.iinfo(dtype.name)
    return bool(limits.min <= least and most <= limits.max)
