"""Everything that was seen of a skin and of the machine that reads it: gathered once, for all checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from skinware.bridge_state import BridgeState
from skinware.memory.statistics import Histogram
from skinware.structure import Structure
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import SerialPort
from skinware_drivers.finding.running import RunningDriver

Counts = Mapping[str, int]


@dataclass(frozen=True)
class Counted:
    """Counters of a bus, a patch or an interface.

    Attributes:
        total: since it exists; counters of a driver: since it was started.
        grown: during the look, or in the whole recording.
    """

    total: Counts
    grown: Counts


@dataclass(frozen=True)
class Change:
    """A change of state, so long after the look or the recording began."""

    time_s: float
    state: str
    reason: str = ""


@dataclass(frozen=True)
class BusSeen:
    """A bus of a driver at the end.

    Attributes:
        state, reason: in the words of ``skin-info``; reason ``""``: none.
        since_s: age of the state; None: unknown.
        load: 0 to 1, in a recording the highest; None: unknown.
        samples: texts of the newest few frames that were not used.
        changes: of its state; the first one is the state at the beginning.
    """

    name: str
    state: str
    reason: str
    since_s: float | None
    load: float | None
    counted: Counted
    samples: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()


@dataclass(frozen=True)
class PatchSeen:
    """A patch of a driver at the end.

    Attributes:
        age_ns: age of its newest data; None: it never sent any.
        interval: times between two updates of a module.
        delay: ages of updates when they were published.
    """

    name: str
    bus: str
    state: str
    sensors: int
    modules: int
    fresh: int
    age_ns: int | None
    counted: Counted
    interval: Histogram
    delay: Histogram
    changes: tuple[Change, ...] = ()


@dataclass(frozen=True)
class TaxelFault:
    """A taxel that is ``dead``, ``stuck``, ``noisy``, ``weak`` or ``clipped``."""

    name: str
    kind: str
    evidence: str


@dataclass(frozen=True)
class HealthSeen:
    """The health of a driver's taxels.

    Attributes:
        source: the judge: ``skin-calm`` or ``these frames``.
        missing: reasons why something could not be judged, by the kind of fault.
    """

    source: str
    judged: int
    faults: tuple[TaxelFault, ...]
    missing: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class DriverTiming:
    """Times of a driver during the look.

    Attributes:
        rate_hz: rate of its snapshots; None: unknown.
        late: delays of its periods.
        age: ages of the newest data when it was published.
        period_ns: nominal; 0: none.
        future_ns: the most by which data was stamped later than it was published; 0: never.
        backwards: times that the times of a module went backwards.
        before_boot: snapshots that were stamped before the machine was started.
    """

    rate_hz: float | None
    late: Histogram
    age: Histogram
    missed: int = 0
    period_ns: int = 0
    future_ns: int = 0
    backwards: int = 0
    before_boot: int = 0
    longest_gap_s: float = 0.0


@dataclass(frozen=True)
class DriverSeen:
    """A driver.

    Attributes:
        life: ``live``, ``silent``, ``paused``, ``starting`` or ``dead``, as in ``skin-info``; at the end of a recording
            also ``closed``.
        pid: of its process; 0: unknown.
        scheduling: of its process, in words; empty: unknown.
        data_path: ``native``, ``mixed``, ``python`` or ``not_told``.
        statuses: number of sensors with each status at the end, ``fresh`` first.
        affected: names of some sensors of each status but ``fresh``.
        lines: names of the rows and columns of matrices that were never good.
        dark: modules that have sent nothing but 0 so far, with the number of their sensors that are suspect; they are
            not among ``lines``.
        health: of its taxels; None: not judged.
    """

    name: str
    namespace: str
    driver_type: str
    life: str
    pid: int
    scheduling: str
    data_path: str
    restarts: int
    frames: int
    structure: Structure
    statuses: Counts
    affected: Mapping[str, tuple[str, ...]]
    lines: tuple[str, ...]
    dark: Mapping[str, int]
    buses: tuple[BusSeen, ...]
    patches: tuple[PatchSeen, ...]
    timing: DriverTiming
    health: HealthSeen | None = None


@dataclass(frozen=True)
class NamespaceSeen:
    """The namespace to examine.

    Attributes:
        problem: the reason why it cannot be read; empty: it can.
        living, dead: names of services whose writer lives, and of those whose writer was killed.
    """

    name: str
    path: str
    problem: str = ""
    damaged: tuple[str, ...] = ()
    living: tuple[str, ...] = ()
    dead: tuple[str, ...] = ()
    bytes_of_dead: int = 0


@dataclass(frozen=True)
class MachineSeen:
    """The machine and its software.

    Attributes:
        load: number of processes that are ready to run, mean of the last minute.
        governors: of the processors, each once; empty: none, or unknown.
        memory_bytes, memory_available_bytes: 0: unknown.
        shared_bytes, shared_free_bytes: of /dev/shm; 0: it is missing.
        shared_problem: the reason why files cannot be made in /dev/shm; empty: they can.
        locked_memory_bytes: the most that this user may lock; -1: unlimited.
        realtime_priority: the highest that this user may request; 0: none.
        limits: settings of the kernel, by name: ``net.core.rmem_max``.
        softnet_dropped: packets that the kernel dropped before any socket, during the look; None: unknown.
        clock_set_s: change of the wall clock by setting it, during the look.
    """

    versions: Mapping[str, str]
    kernel: str
    cpus: int
    load: float
    governors: tuple[str, ...]
    memory_bytes: int
    memory_available_bytes: int
    shared_bytes: int
    shared_free_bytes: int
    shared_problem: str
    locked_memory_bytes: int
    realtime_priority: int
    groups: tuple[str, ...]
    limits: Mapping[str, int]
    softnet_dropped: int | None
    clock_set_s: float


@dataclass(frozen=True)
class RecordingSeen:
    """A recording.

    Attributes:
        is_whole: it was closed in good order.
        services: names of the services in it that are not drivers.
        missed: number of snapshots that were published meanwhile and are missing.
        events: number of events of each kind: ``restarted``, ``dead`` ...
        clock_sets: jumps of the wall clock, because it was set or the machine slept: when, s, and by how much, s.
        boots: number of starts of the machine that it spans.
        recorded_by: program and version; empty: unknown.
    """

    name: str
    size: int
    duration_s: float
    is_whole: bool
    problems: tuple[str, ...]
    services: tuple[str, ...]
    missed: int
    events: Counts
    clock_sets: tuple[tuple[float, float], ...]
    boots: int
    recorded_by: str


@dataclass(frozen=True)
class ReaderSeen:
    """A program that reads a driver snapshot by snapshot, and how many it took and missed during the look."""

    program: str
    pid: int
    driver: str
    frames: int
    missed: int


@dataclass(frozen=True)
class Evidence:
    """Everything that was seen.

    Attributes:
        seconds: duration of the look, or length of the recording.
        machine: this one; nothing is known of the machine that recorded.
        recording: None: a running skin was examined.
        interfaces: CAN interfaces of the kernel at the end, and the counters of the kernel and of their controllers.
        running: living drivers in all namespaces that may be read, without those that publish another driver's data.
        waiting: processes of ``skin-driver`` that have published nothing so far.
    """

    seconds: float
    namespace: str
    drivers: tuple[DriverSeen, ...]
    machine: MachineSeen
    recording: RecordingSeen | None = None
    files: NamespaceSeen | None = None
    interfaces: tuple[tuple[CanInterface, Counted], ...] = ()
    kernel_has_can: bool = True
    ports: tuple[SerialPort, ...] = ()
    running: tuple[RunningDriver, ...] = ()
    waiting: tuple[int, ...] = ()
    readers: tuple[ReaderSeen, ...] = ()
    bridges: tuple[BridgeState, ...] = ()

    @property
    def is_live(self) -> bool:
        return self.recording is None
