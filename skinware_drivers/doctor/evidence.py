"""What was seen of a skin and of the machine that reads it, gathered once; every check looks at the same."""

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
        total: since it was made (of a driver: since it was started).
        grown: while somebody looked; of a recording, in all of it.
        hours: of a recording, in each hour that has data: (hours since it began, what was counted).
    """

    total: Counts
    grown: Counts
    hours: tuple[tuple[int, Counts], ...] = ()


@dataclass(frozen=True)
class Change:
    """A change of state.

    Attributes:
        time_s: since somebody began to look; of a recording, since it began.
        state: from then on.
        reason: for it; empty: none was told.
    """

    time_s: float
    state: str
    reason: str = ""


@dataclass(frozen=True)
class BusSeen:
    """A bus of a driver.

    Attributes:
        name: as the driver was told.
        state, reason: at the end, in the words of ``skin-info``; reason ``""``: none.
        since_s: for how long; None: not told.
        load: 0 to 1; None: not known. Of a recording, the highest.
        counted: its counters.
        samples: texts of frames that were not used, the newest few.
        changes: of its state, the first one is what it was at the beginning.
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
    """A patch of a driver.

    Attributes:
        name: for people.
        bus: name of its bus.
        state: at the end, in the words of ``skin-info``.
        sensors, modules, fresh: how many it has, and how many of its sensors are fresh at the end.
        age_ns: of its newest data at the end; None: it never sent.
        counted: its counters.
        interval: time between two updates of a module, while somebody looked.
        delay: age of an update when it was published, likewise.
        changes: of its state, the first one is what it was at the beginning.
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
    """A taxel that the judge of health calls faulty.

    Attributes:
        name: for people.
        kind: ``dead``, ``stuck``, ``noisy``, ``weak`` or ``clipped``.
        evidence: why, in words.
    """

    name: str
    kind: str
    evidence: str


@dataclass(frozen=True)
class HealthSeen:
    """What is known of the health of a driver's taxels.

    Attributes:
        source: who judged: ``skin-calm`` or what was looked at.
        judged: how many taxels something is known of.
        faults: those with a fault.
        missing: what could not be judged, by kind: why.
    """

    source: str
    judged: int
    faults: tuple[TaxelFault, ...]
    missing: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Timing:
    """Times of a driver.

    Attributes:
        rate_hz: frames a second; None: not known.
        period_ns: its nominal period; 0: it has none.
        missed: periods that it missed while somebody looked.
        missed_before: and before that.
        late: how late its periods began, while somebody looked.
        age: how old the newest data of its frames was when they were published, likewise.
        future_ns: by how much data was stamped later than its frame was published, at most; 0: never.
        backwards: how often the times of a module went backwards.
        before_boot: frames that were stamped before the machine was started.
        longest_gap_s: longest time between two frames.
    """

    rate_hz: float | None
    period_ns: int
    missed: int
    missed_before: int
    late: Histogram
    age: Histogram
    future_ns: int = 0
    backwards: int = 0
    before_boot: int = 0
    longest_gap_s: float = 0.0


@dataclass(frozen=True)
class DriverSeen:
    """A driver.

    Attributes:
        name, namespace, driver_type: of it.
        life: ``live``, ``silent``, ``paused``, ``starting``, ``dead``, as ``skin-info`` calls it; of a recording at its
            end, also ``closed``.
        pid: of its process; 0: not known.
        scheduling: how the kernel schedules it, in words; empty: not known.
        data_path: ``native``, ``mixed``, ``python`` or ``not_told``.
        restarts: how often it came back, while somebody looked.
        frames: that were seen.
        frames_lost: that were published and are not in the recording.
        structure: of its sensors.
        statuses: sensors by status at the end, ``fresh`` first.
        affected: names of some sensors of each status but ``fresh``, for people.
        lines: names of the rows and columns of matrices of which nothing good came.
        dark: modules that sent nothing but 0 so far, with how many of their sensors are suspect; none of
            ``lines``.
        buses, patches: its.
        timing: its.
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
    frames_lost: int
    structure: Structure
    statuses: Counts
    affected: Mapping[str, tuple[str, ...]]
    lines: tuple[str, ...]
    dark: Mapping[str, int]
    buses: tuple[BusSeen, ...]
    patches: tuple[PatchSeen, ...]
    timing: Timing
    health: HealthSeen | None = None


@dataclass(frozen=True)
class NamespaceSeen:
    """A namespace.

    Attributes:
        name, path: of it.
        is_ours: it is the one that was asked for.
        problem: why it cannot be looked at; empty: it can.
        damaged: files that cannot be read, with the reason.
        living, dead: names of services whose writer lives, and of those whose writer was killed.
        bytes_of_dead: what their files take.
        idle_s: for how long no service has come or gone.
    """

    name: str
    path: str
    is_ours: bool
    problem: str = ""
    damaged: tuple[str, ...] = ()
    living: tuple[str, ...] = ()
    dead: tuple[str, ...] = ()
    bytes_of_dead: int = 0
    idle_s: float = 0.0


@dataclass(frozen=True)
class InterfaceSeen:
    """A CAN interface of the kernel.

    Attributes:
        interface: as it was at the end.
        counted: by the kernel and by the controller.
    """

    interface: CanInterface
    counted: Counted


@dataclass(frozen=True)
class MachineSeen:
    """The machine and what is installed.

    Attributes:
        versions: of skinware, Python, numpy ..., by name.
        kernel: release, and the machine's kind.
        cpus: that are switched on.
        load: processes that want one, mean of the last minute.
        governors: of the processors, each once; empty: they have none, or it is not told.
        memory_bytes, memory_available_bytes: of the machine; 0: not known.
        shared_bytes, shared_free_bytes: of /dev/shm; 0: not there.
        shared_problem: why files cannot be made there; empty: they can.
        locked_memory_bytes: that this user may lock; -1: any.
        realtime_priority: the highest that this user may ask for; 0: none.
        groups: that this process is a member of.
        limits: settings of the kernel, by name: ``net.core.rmem_max``.
        softnet_dropped: packets that the machine dropped before any socket saw them, while somebody looked.
        clock_set_s: by how much the wall clock was set, while somebody looked.
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
class ClockSet:
    """The wall clock was set, or the machine slept, in a recording.

    Attributes:
        time_s: when, since the recording began.
        by_s: by how much it went on or back.
    """

    time_s: float
    by_s: float


@dataclass(frozen=True)
class RecordingSeen:
    """A recording.

    Attributes:
        name: of the file.
        size: bytes.
        duration_s: of it.
        is_whole: it was ended in good order.
        problems: what is wrong with it.
        services: names of what is in it and is no driver.
        lost: frames that were published meanwhile and are not in it.
        events: how many there are of each kind: ``restarted``, ``dead`` ...
        clock_sets: times at which the wall clock jumped.
        boots: starts of machines that it spans.
        recorded_by: program and version; empty: not known.
    """

    name: str
    size: int
    duration_s: float
    is_whole: bool
    problems: tuple[str, ...]
    services: tuple[str, ...]
    lost: int
    events: Counts
    clock_sets: tuple[ClockSet, ...]
    boots: int
    recorded_by: str


@dataclass(frozen=True)
class ReaderSeen:
    """A program that reads a driver frame by frame.

    Attributes:
        program, pid: of its process.
        driver: that it reads.
        frames, lost: that it took, and that it did not, while somebody looked.
    """

    program: str
    pid: int
    driver: str
    frames: int
    lost: int


@dataclass(frozen=True)
class Evidence:
    """Everything that was seen.

    Attributes:
        seconds: how long somebody looked; of a recording, its length.
        namespace: that was asked for.
        drivers: in it, or in the recording.
        machine: None: of a recording only what is installed here is known.
        recording: None: the skin was looked at while it ran.
        namespaces: on this machine.
        interfaces: of CAN.
        kernel_has_can: it does.
        ports: serial ones.
        running: living drivers in all namespaces that may be read; without those that publish another one's frames.
        waiting: processes of ``skin-driver`` that have published nothing so far.
        readers: programs that read the drivers frame by frame.
        bridges: over which services come into the namespace, and that run.
    """

    seconds: float
    namespace: str
    drivers: tuple[DriverSeen, ...]
    machine: MachineSeen
    recording: RecordingSeen | None = None
    namespaces: tuple[NamespaceSeen, ...] = ()
    interfaces: tuple[InterfaceSeen, ...] = ()
    kernel_has_can: bool = True
    ports: tuple[SerialPort, ...] = ()
    running: tuple[RunningDriver, ...] = ()
    waiting: tuple[int, ...] = ()
    readers: tuple[ReaderSeen, ...] = ()
    bridges: tuple[BridgeState, ...] = ()

    @property
    def is_live(self) -> bool:
        """Whether the skin was looked at while it ran."""
        return self.recording is None
