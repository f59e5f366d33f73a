"""Programs: drivers that hang or are late, their clocks, readers that do not keep up, and bridges to other robots."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.bridge_state import BridgeState, as_data, summary
from skinware.realtime import NS_PER_S
from skinware.text import age_text, count_text, plural, rate_text
from skinware_drivers.doctor.evidence import DriverSeen, Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, Rule, Severity
from skinware_drivers.doctor.machine import circumstances

_ERROR, _WARNING, _NOTE = Severity.ERROR, Severity.WARNING, Severity.NOTE
_PROGRAMS, _REALTIME, _TIME = "reference/faults.md#programs", "how-to/realtime.md", "explanation/time.md"
_MACHINES = "how-to/two-machines.md"
_JOURNAL = ("journalctl -b -g skin-driver",)
_LATE_NS = 50_000_000
"""Age of data when it is published, from which it is late whatever its period."""
_FUTURE_NS = 1_000_000
_LONG_GAP_S = 1.0
_MISSED_SHARE = 0.01
"""Share of the periods that a busy machine may cost."""
_SET_S = 0.1
_LOST_SHARE = 0.05
"""Share of the snapshots that a link may skip without a note."""

NO_DRIVER = Rule(
    _ERROR,
    "no driver has published anything",
    "see what is plugged in and start a driver; if one runs, see its log and its boards (power, bit rate)",
    ("skin-doctor --namespace {elsewhere}", "skin-find", "skin-driver --bus can0"),
    "tutorials/first-run.md",
)
SLOW_READER = Rule(
    _WARNING,
    "a program reads every snapshot of a driver, and does not keep up",
    "give that program more processor time, or start the driver with more slots for snapshots: --slots 64",
    ("skin-info",),
    _PROGRAMS,
)
LIVES = {
    "dead": Rule(
        _ERROR, "the driver was killed", "start it again; its readers continue by themselves", _JOURNAL, _PROGRAMS
    ),
    "silent": Rule(
        _ERROR,
        "the driver runs and publishes nothing",
        "see whether it is stopped (T); end it and start it again",
        ("ps -o pid,stat,wchan:20,args -p {pid}",),
        _PROGRAMS,
    ),
    "starting": Rule(
        _WARNING,
        "the driver has published nothing yet",
        "wait; if that does not help, see its log",
        ("skin-info {driver} --watch",),
    ),
    "paused": Rule(_NOTE, "the driver is paused", "resume it from the program that paused it", ("skin-info {driver}",)),
}
"""By the life of the driver."""
RESTARTED = Rule(_WARNING, "the driver was restarted", "see its log", _JOURNAL, _PROGRAMS)
MISSED = Rule(
    _WARNING, "the driver misses periods", "start it with more processor time: --realtime fifo:50", see=_REALTIME
)
OLD = Rule(
    _WARNING,
    "data is old when it is published",
    "start it with more processor time (--realtime fifo:50); if it waits for one patch of its cycle, with"
    " --publish rate",
    see="troubleshooting.md#data-is-missing",
)
GAP = Rule(
    _WARNING,
    "nothing was published for a while",
    "see what held the driver up: its log, and the load of the machine",
    _JOURNAL,
    _REALTIME,
)
AHEAD = Rule(
    _WARNING,
    "data is stamped later than it was published",
    "the clock of a device or controller runs ahead; start the driver without its stamps:"
    " --bus 'can0?timestamps=kernel'",
    see=_TIME,
)
BACKWARDS = Rule(
    _WARNING,
    "times of data went backwards",
    "the clock of a device or controller was reset; if that goes on, start the driver without its stamps:"
    " --bus 'can0?timestamps=kernel'",
    see=_TIME,
)
BEFORE_BOOT = Rule(
    _NOTE,
    "data was stamped before the machine was started",
    "a clock was set; nothing, if the number does not grow",
    ("skin-info {driver}",),
    _TIME,
)
NOT_HEARD = Rule(
    _ERROR,
    "a robot is not heard over its bridge",
    "see what skin-bridge join prints, check the network, and whether skin-bridge serve runs on the robot",
    see=_MACHINES,
)
SLOW_LINK = Rule(
    _NOTE,
    "the link is too slow for all snapshots",
    "use a faster link",
    see="how-to/two-machines.md#links-that-are-slow-long-or-cut",
)
REFUSED = Rule(
    _WARNING,
    "messages of a robot cannot be read",
    "install the same version on both machines; if it is the same, another program sends under this robot's name",
    see=_MACHINES,
)
NAMESAKES = Rule(
    _WARNING,
    "several robots have one name",
    "give each robot a name of its own: skin-bridge serve --robot NAME",
    see=_MACHINES,
)


def check_timing(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        yield Looked(f"driver {driver.name}", _driver_as_seen(driver, evidence))
        yield from _life(driver)
        if driver.life != "dead":
            yield from _late(driver, evidence)
        yield from _clock(driver)
    for one in evidence.readers:
        yield Looked(f"reader {one.program}", f"{one.frames} snapshots of {one.driver} taken, {one.missed} missed")
        if one.missed:
            yield SLOW_READER.found(
                f"{one.program}, pid {one.pid}, reads {one.driver}",
                f"{plural(one.missed, 'snapshot')} missed and {one.frames} taken in {evidence.seconds:.1f} s",
            )
    if evidence.is_live:
        if not evidence.drivers:
            yield _no_driver(evidence)
        by_s = evidence.machine.clock_set_s
        change = f"set by {by_s:+.1f} s meanwhile" if abs(by_s) > _SET_S else "not set meanwhile"
        yield Looked("wall clock", f"{change}; times of data come from a clock that cannot be set")


def _driver_as_seen(driver: DriverSeen, evidence: Evidence) -> str:
    times = driver.timing
    parts = [driver.life, rate_text(times.rate_hz)]
    if times.period_ns:
        parts.append(f"nominally {rate_text(NS_PER_S / times.period_ns)}")
    if evidence.is_live:
        parts.append(f"{plural(times.missed, 'period')} missed")
    if (bound := times.late.quantile_ns(0.99)) is not None:
        parts.append(f"published late by up to {age_text(bound)} (99 %)")
    if (bound := times.age.quantile_ns(0.99)) is not None:
        parts.append(f"data up to {age_text(bound)} old (99 %)")
    if not evidence.is_live:
        parts.append(f"longest gap {age_text(times.longest_gap_s * 1e9)}")
    return ", ".join(parts)


def _no_driver(evidence: Evidence) -> Finding:
    seen = f"there is none in /dev/shm/skinware.{evidence.namespace}"
    if evidence.running:
        seen += f"; elsewhere: {', '.join(map(str, evidence.running))}"
    if evidence.waiting:
        pids = ", ".join(map(str, evidence.waiting))
        seen += f"; skin-driver runs (pid {pids}), and has found no device so far"
    elsewhere = {"elsewhere": evidence.running[0].namespace} if evidence.running else {}
    return NO_DRIVER.found(f"namespace {evidence.namespace}", seen, **elsewhere)


def _life(driver: DriverSeen) -> Iterator[Finding]:
    where = f"driver {driver.name}"
    ages = [patch.age_ns for patch in driver.patches if patch.age_ns is not None]
    age = f"its newest data is {age_text(min(ages))} old" if ages else "it published no data"
    seen = {
        "dead": f"pid {driver.pid} is gone; {age}",
        "silent": f"pid {driver.pid}, stopped or hung; {age}",
        "starting": f"pid {driver.pid}",
        "paused": f"pid {driver.pid}; {age}",
    }
    if driver.life in LIVES:
        yield LIVES[driver.life].found(where, seen[driver.life], driver=driver.name, pid=driver.pid)
    if driver.restarts:
        yield RESTARTED.found(where, plural(driver.restarts, "time"))


def _late(driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    times, where, period = driver.timing, f"driver {driver.name}", f"period {age_text(driver.timing.period_ns)}"
    why = circumstances(evidence, driver)
    periods = evidence.seconds * NS_PER_S / times.period_ns if times.period_ns else 0
    if times.missed > _MISSED_SHARE * periods:
        yield MISSED.found(where, f"{times.missed} of {periods:.0f} in {evidence.seconds:.1f} s; {why}")
    bound = times.age.quantile_ns(0.99)
    limit = max(2 * times.period_ns, _LATE_NS)
    if bound is not None and bound > 2 * limit:  # the bound is up to twice the true value
        worst = max(driver.patches, key=lambda patch: patch.delay.quantile_ns(0.99) or 0, default=None)
        which = f"; worst: {worst.name}" if worst is not None else ""
        yield OLD.found(where, f"99 % at most {age_text(bound)}, {period}{which}; {why}")
    if times.longest_gap_s > max(_LONG_GAP_S, 5e-9 * times.period_ns) and driver.life != "paused":
        yield GAP.found(where, f"{age_text(times.longest_gap_s * 1e9)}, {period}; {why}")


def _clock(driver: DriverSeen) -> Iterator[Finding]:
    times, where = driver.timing, f"driver {driver.name}"
    if times.future_ns > _FUTURE_NS:
        yield AHEAD.found(where, f"by up to {age_text(times.future_ns)}")
    if times.backwards:
        yield BACKWARDS.found(where, plural(times.backwards, "time"))
    if times.before_boot:
        yield BEFORE_BOOT.found(where, plural(times.before_boot, "frame"), driver=driver.name)


def check_bridges(evidence: Evidence) -> Iterator[Note]:
    for bridge in evidence.bridges:
        where, state = f"robot {bridge.robot}", summary(bridge.robot, as_data(bridge))
        yield Looked(where, state)
        if not bridge.is_up:
            yield NOT_HEARD.found(where, state)
        yield from _slow_services(bridge)
        if bridge.refused:
            yield REFUSED.found(where, f"{count_text(bridge.refused)} so far; the last: {bridge.last_refused}")
        if bridge.namesakes or bridge.switches:
            followed = f"bridge {bridge.instance[:8]}{' on ' if bridge.host else ''}{bridge.host} is followed"
            others = f"{bridge.namesakes} other now, {bridge.switches} switches between robots so far"
            yield NAMESAKES.found(where, f"{followed}; {others}")


def _slow_services(bridge: BridgeState) -> Iterator[Finding]:
    for name, service in bridge.services.items():
        all_hz = service.rate_hz + service.gap_hz
        if service.state == "live" and service.gap_hz > _LOST_SHARE * all_hz and service.age_p50_ns is not None:
            rates = f"{rate_text(service.rate_hz)} of {rate_text(all_hz)} come"
            seen = f"{rates}, {age_text(service.age_p50_ns)} old (p50)"
            yield SLOW_LINK.found(f"{name} of robot {bridge.robot}", seen)
