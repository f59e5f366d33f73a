"""The service that calms a driver: it reads it, takes its frames through a chain, and publishes them as a driver."""

from __future__ import annotations

import inspect
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from skinware.driver_service import DriverReader, DriverWriter
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import (
    BadServiceFile,
    ConfigurationError,
    Overrun,
    Paused,
    ServiceNotFound,
    ServiceTimeout,
    StructureChanged,
    StructureError,
)
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns
from skinware.service import Request
from skinware.service.messages import ACQUIRE
from skinware.status import PatchState, Status
from skinware.structure import Structure
from skinware.tactile import contacts_service, health_service
from skinware.tactile.baseline import Baseline
from skinware.tactile.calm_contacts import CalmContacts, CalmHealth, WatchedRegions
from skinware.tactile.chain import Chain, ChainSettings
from skinware.tactile.chain_state import LearnedState

log: logging.Logger = logging.getLogger("skinware.calm")

_WAIT_S = WAIT_SLICE_NS / NS_PER_S
_DRIVER_TYPE = "calm"


class CalmService:
    """Publishes a calmed driver under the same name in another namespace, until it is stopped.

    The driver may stop, restart and change: the service waits for it, and goes on with what it had learned of each
    sensor. Use it in one thread; ``stop`` may come from any, and from a signal handler.

    Args:
        name: of the driver.
        settings: what happens to it; default: a baseline.
        namespace: of the driver; default: the one of ``SKINWARE_NAMESPACE``.
        into: namespace of the calmed driver.
        group: whose members may read it.
        state_path: file for what was learned; None: it is not kept.
        contacts: name of the service of its contacts, in the namespace of the calmed driver; None: there is none.
        watched: regions whose motion is published beside the contacts; None: none.
        health: name of the service of its sensors' health, likewise; None: nobody looks after it.
        on_ready: called when the first frame was published, and whenever the structure is another.

    Attributes:
        frames: that were taken.
        restored: sensors that went on with what the file had.
        contacts: of what touches it; None: they are not wanted.
        health: of its sensors; None: it is not wanted.

    Raises:
        ConfigurationError: both namespaces are the same, or a bad name.
    """

    def __init__(
        self,
        name: str,
        settings: ChainSettings | None = None,
        *,
        namespace: Namespace | str | None = None,
        into: Namespace | str = "calm",
        group: str | None = None,
        state_path: Path | None = None,
        contacts: str | None = contacts_service.NAME,
        watched: WatchedRegions | None = None,
        health: str | None = health_service.NAME,
        on_ready: Callable[[], object] = lambda: None,
    ) -> None:
        self.name = name
        self.namespace: Namespace = Namespace.of(namespace)
        self.into: Namespace = Namespace.of(into)
        if self.namespace.name == self.into.name:
            raise ConfigurationError(f"{name!r} is in namespace {self.into.name!r} itself: give another with --into")
        self.frames = 0
        self.restored = 0
        self.contacts: CalmContacts | None = (
            CalmContacts(contacts, name, self.into, group, watched) if contacts else None
        )
        self.health: CalmHealth | None = CalmHealth(health, name, self.into, group) if health else None
        self._settings = settings or ChainSettings.calm()
        self._group, self._on_ready = group, on_ready
        self._learned = LearnedState(state_path, self.health)
        self._reader: DriverReader | None = None
        self._writer: DriverWriter | None = None
        self._chain: Chain | None = None
        self._counters: tuple[list[bytes], list[bytes]] = ([], [])
        self._copied: list[str] = []
        self._not_told: list[str] = []
        self._is_ready = self._is_lost = self._stopping = False
        self._last: DriverSnapshot | None = None
        self._structure: Structure | None = None
        self._touched: dict[str, int] = {}
        self._refused: set[str] = set()
        self._waiting: list[tuple[int, Request]] = []
        self._operations: dict[str, Callable[..., object]] = {
            "tare": self.tare,
            "hold": self.hold,
            "settings": self.settings,
        }

    # -- operations ---------------------------------------------------------------------------------------------

    def tare(self, patch: str | None = None, type: str | None = None) -> dict[str, int]:  # noqa: A002 - its users' word
        """Take the present values for the rest, of all sensors or of one patch or type; how many those are."""
        chain = self._running_chain()
        number = None
        if patch is not None:
            names = chain.structure.patch_names
            if patch not in names:
                raise ConfigurationError(f"no patch {patch!r}; there are: {', '.join(names)}")
            number = names.index(patch)
        return {name: baseline.tare(number) for name, baseline in self._baselines(type).items()}

    def hold(self, on: bool = True, type: str | None = None) -> dict[str, bool]:  # noqa: A002
        """Leave all baselines as they are, but for common drift; with on=false go on."""
        if not isinstance(on, bool):
            raise ConfigurationError(f"on = {on!r}: give true or false")
        found = self._baselines(type)
        for baseline in found.values():
            baseline.hold(on)
        return dict.fromkeys(found, on)

    def settings(self, type: str | None = None, **changes: Any) -> dict[str, dict[str, Any]]:  # noqa: A002
        """Change settings of the baselines until the service ends; those that hold then. Without any: tell them."""
        found = self._baselines(type)
        changed = {name: baseline.settings.changed(changes) for name, baseline in found.items()}  # all or none
        for name, baseline in found.items():
            baseline.settings = changed[name]
        return {name: {key: getattr(one, key) for key in one.__struct_fields__} for name, one in changed.items()}

    # -- running ------------------------------------------------------------------------------------------------

    def run(self, report: Callable[[], object] = lambda: None, every_s: float = 1.0) -> None:
        """Calm the driver until ``stop``.

        Args:
            report: called besides, again and again.
            every_s: how often.

        Raises:
            NameInUse, NamespaceError: as a writer.
            ConfigurationError: a stage cannot be made for the driver.
        """
        next_report_ns = now_ns() + round(every_s * NS_PER_S)
        try:
            while not self._stopping:
                frame = self._next_frame()
                self._answer()
                if frame is not None:
                    self._publish(frame)
                self._learned.keep(self._chain)
                if now_ns() >= next_report_ns:
                    next_report_ns = now_ns() + round(every_s * NS_PER_S)
                    report()
        finally:
            self._learned.close(self._chain)
            for end in (self.contacts, self.health, self._writer, self._reader):
                if end is not None:
                    end.close()

    def stop(self) -> None:
        """End ``run`` within some 50 ms."""
        self._stopping = True

    def status(self) -> dict[str, Any]:
        """What it does, for programs."""
        baselines = {} if self._chain is None else self._chain.baselines
        return {
            "sequence": 0 if self._writer is None else self._writer.sequence,
            "driver_alive": self._reader is not None and self._reader.alive,
            "frames": self.frames,
            "lost": 0 if self._reader is None else self._reader.lost,
            "restored": self.restored,
            "ready": {name: int(baseline.ready.sum()) for name, baseline in baselines.items()},
            "refused": {name: baseline.refused_share for name, baseline in baselines.items()},
            "touched": dict(self._touched),
            "contacts": 0 if self.contacts is None else self.contacts.count,
            "faulty": 0 if self.health is None else self.health.faulty,
        }

    @property
    def chain(self) -> Chain | None:
        """The chain for the driver as it is; None before it was seen."""
        return self._chain

    # -- reading the driver -------------------------------------------------------------------------------------

    def _next_frame(self) -> DriverSnapshot | None:
        """The driver's newest frame, if a newer one came within 50 ms."""
        if self._reader is None:
            self._reader = self._attached()
            return None
        try:
            frame = self._reader.read(newer_than=self._last, timeout_s=_WAIT_S)
        except (ServiceTimeout, Overrun):
            self._mark_lost()
            return None
        except StructureChanged:
            self._reattach()
            return None
        if frame.stale:
            self._last = frame
            return None  # what a dead driver left
        return frame

    def _attached(self) -> DriverReader | None:
        try:
            return DriverReader(self.name, namespace=self.namespace)
        except (ServiceNotFound, BadServiceFile):
            time.sleep(_WAIT_S)
            return None

    def _reattach(self) -> None:
        assert self._reader is not None  # noqa: S101 - it said that the structure is another
        try:
            self._reader.reattach()
        except (ServiceNotFound, BadServiceFile):
            time.sleep(_WAIT_S)

    def _mark_lost(self) -> None:
        """Tell the readers, once, that the driver is dead: all that is shown is old."""
        reader, writer = self._reader, self._writer
        if reader is None or writer is None or self._is_lost or reader.alive or not self._is_ready or writer.paused:
            return
        self._is_lost = True
        columns = writer.begin(from_last=True)
        columns["status"] |= np.uint8(Status.STALE)
        live = columns["patch_state"] == PatchState.LIVE
        columns["patch_state"][live] = PatchState.STALE
        writer.commit(now_ns())
        if self.contacts is not None:
            self.contacts.publish_none(now_ns())

    # -- publishing ---------------------------------------------------------------------------------------------

    def _publish(self, frame: DriverSnapshot) -> None:
        if frame.structure is not self._structure:
            self._follow(frame)
        chain, writer = self._chain, self._writer
        assert chain is not None  # noqa: S101 - _follow made it
        assert writer is not None  # noqa: S101
        self._last, self._is_lost = frame, False
        self.frames += 1
        try:
            columns = writer.begin()
        except Paused:
            return
        chain.step(frame, columns["values"], columns["status"])
        if self.health is not None:
            self.health.step(columns["status"], frame.acquired_ns)
        for name in self._copied:
            columns[name][:] = frame.column(name)
        self._touched = {
            name: int(np.count_nonzero(columns["values"][chain.structure.index(name)])) for name in chain.baselines
        }
        for name in self._not_told:
            columns[name][:] = 0
        self._tell_refusals(chain)
        writer.commit(frame.acquired_ns)
        if self.contacts is not None:
            self.contacts.publish(columns["values"], columns["status"], frame.acquired_ns)
        waiting, self._waiting = self._waiting, []
        for asked_ns, request in waiting:
            if frame.acquired_ns >= asked_ns:
                request.reply(position=writer.position)
            else:
                self._waiting.append((asked_ns, request))
        if not self._is_ready:
            self._is_ready = True
            self._on_ready()

    def _tell_refusals(self, chain: Chain) -> None:
        for name, baseline in chain.baselines.items():
            if baseline.refused_share and name not in self._refused:
                log.warning(
                    "%s: no baselines yet for %.0f %% of the sensors: they move; each has one when it rested for %g s,"
                    " or after a tare",
                    name,
                    100 * baseline.refused_share,
                    baseline.settings.calibrate_s,
                )
                self._refused.add(name)
            elif not baseline.refused_share:
                self._refused.discard(name)

    def _follow(self, frame: DriverSnapshot) -> None:
        assert self._reader is not None  # noqa: S101 - the frame is its
        before, known = self._chain, self._structure
        self._structure = frame.structure
        if known is not None and frame.structure == known:
            return
        chain = self._settings.chain(frame.structure)
        learned = None if before is None else self._learned.state(before)
        static = self._reader.static()
        counters = tuple(
            static[f"{what}_counter_name"].tolist() if f"{what}_counter_name" in static else []
            for what in ("bus", "patch")
        )
        rate_hz = NS_PER_S / frame.period_ns if frame.period_ns else None
        if self._writer is not None and counters == self._counters:
            self._writer.restructure(chain.structure, rate_hz=rate_hz)
        else:
            if self._writer is not None:
                self._writer.close()
            bus_counters, patch_counters = ([bytes(name).decode() for name in names] for names in counters)
            self._writer = DriverWriter(
                self.name,
                chain.structure,
                driver_type=_DRIVER_TYPE,
                bus_counters=bus_counters,
                patch_counters=patch_counters,
                namespace=self.into,
                rate_hz=rate_hz,
                group=self._group,
                operations=self._operations,
            )
            self._writer.request_server()
        own = set(self._writer.column_offsets()) - {"values", "status"}
        if self.contacts is not None:
            self.contacts.follow(chain, rate_hz)
        if self.health is not None:
            self.health.follow(chain)
        restored = self._learned.restore(chain, learned)
        self.restored = restored if before is None else self.restored
        self._copied = sorted(own & set(self._reader.schema.columns))
        self._not_told = sorted(own - set(self._copied))
        self._chain, self._counters, self._is_ready = chain, counters, False

    # -- requests -----------------------------------------------------------------------------------------------

    def _answer(self) -> None:
        if self._writer is None:
            return
        self._writer.keep_files()
        self._waiting = [(asked_ns, request) for asked_ns, request in self._waiting if not request.cancelled]
        for request in self._writer.request_server().take():
            if request.operation == ACQUIRE:
                self._waiting.append((now_ns(), request))
            else:
                self._carry_out(request)

    def _carry_out(self, request: Request) -> None:
        operation = self._operations[request.operation]
        try:
            inspect.signature(operation).bind(**request.arguments)
        except TypeError as error:
            request.fail(f"{request.operation}: {error}", "refused")
            return
        try:
            result = operation(**request.arguments)
        except (ConfigurationError, StructureError) as error:
            request.fail(f"{request.operation}: {error}")
        else:
            request.reply(result, (0, 0) if self._writer is None else self._writer.position)

    def _running_chain(self) -> Chain:
        if self._chain is None:
            raise ConfigurationError(f"driver {self.name!r} has not been seen yet")
        return self._chain

    def _baselines(self, type_name: str | None) -> dict[str, Baseline]:
        found = self._running_chain().baselines
        if type_name is not None and type_name not in found:
            raise ConfigurationError(f"no baseline of {type_name!r}; there are: {', '.join(found) or 'none'}")
        return found if type_name is None else {type_name: found[type_name]}
