"""Run the service that calms a driver: it reads the driver, takes its samples through a chain, and publishes them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverWriter
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import Request
from skinware.state import count_reasons
from skinware.status import Why
from skinware.tactile import contacts_service, health_service
from skinware.tactile.baseline import Baseline
from skinware.tactile.calm_driver import CalmedDriver, DriverSource
from skinware.tactile.chain import Chain, ChainSettings
from skinware.tactile.chain_state import LearnedState
from skinware.tactile.derived_services import CalmContacts, CalmHealth, CalmMotion
from skinware.tactile.motion import NAME as MOTION
from skinware.tactile.regions import Regions

log: logging.Logger = logging.getLogger("skinware.calm")


class CalmRequests:
    """Answers the requests of programs: the operations ``tare``, ``hold`` and ``settings``, and ``acquire``.

    The chain of the driver is None before it was seen.
    """

    def __init__(self, driver: str) -> None:
        self._driver = driver
        self.chain: Chain | None = None
        self._waiting: list[tuple[int, Request]] = []  # requests for a frame, each with the time at which it came

    @property
    def operations(self) -> dict[str, Callable[..., object]]:
        return {"tare": self.tare, "hold": self.hold, "settings": self.settings}

    def tare(self, patch: str | None = None, type: str | None = None) -> dict[str, int]:  # noqa: A002 - its users' word
        """Take the present values as the rest, of all sensors or of one patch or type; returns how many, by type."""
        baselines, number = self._baselines(type), None
        if patch is not None and self.chain is not None:
            names = self.chain.structure.patch_names
            if patch not in names:
                raise ConfigurationError(f"no patch {patch!r}; there are: {', '.join(names)}")
            number = names.index(patch)
        return {name: baseline.tare(number) for name, baseline in baselines.items()}

    def hold(self, on: bool = True, type: str | None = None) -> dict[str, bool]:  # noqa: A002
        """Leave all baselines as they are, except for common drift; with on=false go on."""
        if not isinstance(on, bool):
            raise ConfigurationError(f"on = {on!r}: give true or false")
        found = self._baselines(type)
        for baseline in found.values():
            baseline.hold(on)
        return dict.fromkeys(found, on)

    def settings(self, type: str | None = None, **changes: Any) -> dict[str, dict[str, Any]]:  # noqa: A002
        """Change settings of the baselines until the service ends; returns all settings, by type."""
        found = self._baselines(type)
        changed = {name: baseline.settings.changed(changes) for name, baseline in found.items()}  # all or none
        for name, baseline in found.items():
            baseline.settings = changed[name]
        return {name: {key: getattr(one, key) for key in one.__struct_fields__} for name, one in changed.items()}

    def answer(self, writer: DriverWriter) -> None:
        """Answer the requests that have come; those for a sample wait for :meth:`published`."""
        self._waiting += [(now_ns(), request) for request in writer.answer_requests()]

    def published(self, acquired_ns: int, writer: DriverWriter) -> None:
        """Answer the requests for a sample that came before the newest sample was acquired."""
        for asked_ns, request in self._waiting:
            if acquired_ns >= asked_ns:
                request.reply(position=writer.position)
        self._waiting = [(asked_ns, of) for asked_ns, of in self._waiting if acquired_ns < asked_ns]

    def _baselines(self, type_name: str | None) -> dict[str, Baseline]:
        if self.chain is None:
            raise ConfigurationError(f"driver {self._driver!r} has not been seen yet")
        found = self.chain.baselines
        if type_name is not None and type_name not in found:
            raise ConfigurationError(f"no baseline of {type_name!r}; there are: {', '.join(found) or 'none'}")
        return found if type_name is None else {type_name: found[type_name]}


class CalmService:
    """Publishes a calmed driver under the same name in another namespace, until it is stopped.

    The driver may stop, restart and change: the service waits for it, and goes on with what it had learned of each
    sensor. Use it in one thread; ``stop`` may come from any, and from a signal handler.

    Args:
        name: name of the driver.
        settings: settings of its chain; default: a baseline.
        namespace: of the driver; default: the one of ``SKINWARE_NAMESPACE``.
        into: namespace of the calmed driver.
        group: group whose members may read it.
        state_path: file that keeps what was learned; None: it is not kept.
        contacts: name of the service of its contacts, in the namespace of the calmed driver; None: there is none.
        regions: regions whose motion is published beside the contacts; None: none.
        motion: name of the service of their motion, in the same namespace.
        poses: by name of a coordinate frame, (4, 4) its pose on the robot: contacts hang together across its border.
        health: name of the service of its sensors' health, in the same namespace; None: there is none.

    Attributes:
        frames: number of samples that were taken.
        contacts: the service of its contacts.
        motion: the service of the motion of regions.
        health: the service of the health of its sensors.

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
        regions: Regions | None = None,
        motion: str = MOTION,
        poses: Mapping[str, npt.ArrayLike] | None = None,
        health: str | None = health_service.NAME,
    ) -> None:
        self.name = name
        self.namespace: Namespace = Namespace.of(namespace)
        self.into: Namespace = Namespace.of(into)
        if self.namespace.name == self.into.name:
            raise ConfigurationError(f"{name!r} is in namespace {self.into.name!r} itself: give another with --into")
        self.frames = 0
        self.contacts = CalmContacts(contacts, name, self.into, group, poses)
        moving = (motion, regions) if regions is not None else ("", Regions(()))
        self.motion = CalmMotion(moving[0], name, self.into, group, moving[1], self.contacts)
        self.health = CalmHealth(health, name, self.into, group)
        self._settings = settings or ChainSettings.calm()
        self._learned = LearnedState(state_path)
        self._requests = CalmRequests(name)
        self._source = DriverSource(name, self.namespace)
        self._calmed = CalmedDriver(name, self.into, group, self._requests.operations)
        self._state: Literal["waiting", "running", "lost"] = "waiting"
        self._warned: set[tuple[str, str]] = set()
        self._stopping = False

    def run(
        self,
        report: Callable[[], object] = lambda: None,
        every_s: float = 1.0,
        on_ready: Callable[[], object] = lambda: None,
    ) -> None:
        """Calm the driver until ``stop``.

        Args:
            report: called again and again.
            every_s: how often.
            on_ready: called after the first sample, and after the first sample of every other structure.

        Raises:
            NameInUse, NamespaceError: as a writer.
            ConfigurationError: a stage cannot be made for the driver.
        """
        next_report_ns = now_ns() + round(every_s * NS_PER_S)
        try:
            while not self._stopping:
                frame = self._source.next_frame()
                if self._calmed.writer is not None:
                    self._requests.answer(self._calmed.writer)
                if frame is None:
                    self._publish_lost()
                elif self._publish(frame):
                    on_ready()
                self._learned.keep(self.chain)
                if now_ns() >= next_report_ns:
                    next_report_ns = now_ns() + round(every_s * NS_PER_S)
                    report()
        finally:
            self._learned.close(self.chain)
            for end in (self.motion, self.contacts, self.health, self._calmed, self._source):
                end.close()

    def stop(self) -> None:
        """End ``run`` within some 50 ms."""
        self._stopping = True

    @property
    def restored(self) -> int:
        """Number of sensors that went on with what the file had."""
        return self._learned.restored

    @property
    def chain(self) -> Chain | None:
        """The chain for the present structure of the driver; None before it was seen."""
        return self._requests.chain

    def status(self) -> dict[str, Any]:
        """Return figures of its work, for programs."""
        stages = {} if self.chain is None else self.chain.baseline_stages
        reader, writer = self._source.reader, self._calmed.writer
        return {
            "sequence": 0 if writer is None else writer.sequence,
            "driver_alive": self._source.alive,
            "frames": self.frames,
            "missed": 0 if reader is None else reader.missed,
            "restored": self.restored,
            "ready": {name: int(stage.baseline.ready.sum()) for name, stage in stages.items()},
            "refused": {name: stage.baseline.refused_share for name, stage in stages.items()},
            "touched": {name: int(stage.shown.touched.sum()) for name, stage in stages.items()},
            "why": {name: count_reasons(stage.calm.why) for name, stage in stages.items() if stage.calm is not None},
            "contacts": 0 if self.contacts.newest is None else len(self.contacts.newest[0]),
            "faulty": self.health.faulty,
        }

    def _follow(self, frame: DriverSnapshot) -> None:
        """Go on with another structure of the driver."""
        assert self._source.reader is not None  # noqa: S101 - it read the frame
        before, chain = self.chain, self._settings.chain(frame.structure)
        learned = None if before is None else before.state()
        rate_hz = NS_PER_S / frame.period_ns if frame.period_ns else None
        self._calmed.follow(chain.structure, self._source.reader, rate_hz)
        for derived in (self.contacts, self.motion, self.health):
            derived.follow(chain, rate_hz)
        self._learned.restore(chain, learned)
        self._requests.chain, self._state = chain, "waiting"

    def _publish(self, frame: DriverSnapshot) -> bool:
        """Calm a sample and publish it; return whether it is the first one of a structure."""
        if self._source.has_changed(frame):
            self._follow(frame)
        chain, writer = self.chain, self._calmed.writer
        assert chain is not None  # noqa: S101 - _follow made both
        assert writer is not None  # noqa: S101
        self.frames += 1
        columns = self._calmed.begin(frame)
        if columns is None:
            return False
        chain.step(frame, columns["values"], columns["status"])
        chain.explain(columns["uncertainty"], columns["why"])
        self.health.mark(columns["status"])
        writer.commit(frame.acquired_ns)
        self.contacts.publish(frame.acquired_ns)
        self.motion.publish(frame.acquired_ns)
        self.health.update(frame.acquired_ns)  # after all that programs wait for
        self._warn(chain)
        self._requests.published(frame.acquired_ns, writer)
        before, self._state = self._state, "running"
        return before == "waiting"

    def _publish_lost(self) -> None:
        """Publish once, if the driver is dead, that all values are old and that nothing is touched."""
        writer = self._calmed.writer
        if self._source.alive or self._state != "running" or writer is None or writer.paused:
            return
        self._state = "lost"
        self._calmed.publish_stale()
        time_ns = now_ns()
        assert self.chain is not None  # noqa: S101 - there was a frame
        self.chain.lose()
        self.contacts.publish(time_ns)
        self.motion.publish(time_ns)

    def _warn(self, chain: Chain) -> None:
        """Warn once of being too slow, of sensors that wait for their baselines, and of those that a touch lowers."""
        reader = self._source.reader
        if reader is not None and reader.is_too_slow and self._is_new(("", "slow"), True):
            log.warning(
                "%s: samples come faster than they can be taken: only the newest are, as long as that is so", self.name
            )
        for name, stage in chain.baseline_stages.items():
            share = stage.baseline.refused_share
            if self._is_new((name, "moves"), share > 0):
                log.warning(
                    "%s: no baselines yet for %.0f %% of the sensors: they move; each gets one when it has rested for"
                    " %g s, or at a tare",
                    name,
                    100 * share,
                    stage.baseline.settings.calibrate_s,
                )
            if self._is_new((name, "doubted"), stage.baseline.doubts):
                log.warning(
                    "%s: sensors fall and return where nothing touches (%d so far): if a touch lowers them, put a stage"
                    " amplifier with gain -1 before the baseline",
                    name,
                    np.count_nonzero(stage.shown.why == Why.DOUBTED),
                )

    def _is_new(self, what: tuple[str, str], is_there: bool) -> bool:
        is_new = is_there and what not in self._warned
        (self._warned.add if is_there else self._warned.discard)(what)
        return is_new
