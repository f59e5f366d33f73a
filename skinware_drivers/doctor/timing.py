"""Times: drivers that hang or are late, how old data is when it is published, and clocks that jump."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.realtime import NS_PER_S
from skinware.text import age_text, plural, rate_text
from skinware_drivers.doctor.evidence import DriverSeen, Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, Severity
from skinware_drivers.doctor.machine import circumstances

AREA = "timing"
_REALTIME, _TIME = "how-to/realtime.md", "explanation/time.md"
_LATE_NS = 50_000_000
"""Data that is so old when it is published is late, whatever its period."""
_FUTURE_NS = 1_000_000
_LONG_GAP_S = 1.0
_MISSED_SHARE = 0.01
"""Of the periods, that a busy machine may cost."""
_SET_S = 0.1


def check(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        yield Looked(AREA, f"driver {driver.name}", _as_seen(driver, evidence))
        yield from _life(driver)
        if driver.life != "dead":
            yield from _late(driver, evidence)
        yield from _clock(driver)
    yield from _readers(evidence)
    if evidence.is_live and not evidence.drivers:
        yield from _nobody(evidence)
    if evidence.is_live:
        by_s = evidence.machine.clock_set_s
        told = f"set by {by_s:+.1f} s meanwhile" if abs(by_s) > _SET_S else "not set meanwhile"
        yield Looked(AREA, "wall clock", f"{told}; times of data are of a clock that nobody sets")


def _as_seen(driver: DriverSeen, evidence: Evidence) -> str:
    times = driver.timing
    parts = [driver.life, rate_text(times.rate_hz)]
    if times.period_ns:
        parts.append(f"nominally {rate_text(NS_PER_S / times.period_ns)}")
    if evidence.is_live:
        parts.append(f"{plural(times.missed, 'period')} missed")
    for what, histogram in (("published late by", times.late), ("data", times.age)):
        bound = histogram.quantile_ns(0.99)
        if bound is not None:
            parts.append(f"{what} up to {age_text(bound)}{' old' if what == 'data' else ''} (99 %)")
    if not evidence.is_live:
        parts.append(f"longest gap {age_text(times.longest_gap_s * 1e9)}")
    return ", ".join(parts)


def _nobody(evidence: Evidence) -> Iterator[Finding]:
    elsewhere = [str(one) for one in evidence.running]
    told = f"; elsewhere: {', '.join(elsewhere)}" if elsewhere else ""
    if evidence.waiting:
        pids = ", ".join(map(str, evidence.waiting))
        told += f"; skin-driver runs (pid {pids}), and has found no device so far"
    there = [f"skin-doctor --namespace {one.namespace}" for one in evidence.running[:1]]
    yield Finding(
        Severity.ERROR,
        AREA,
        "no driver has published anything",
        f"namespace {evidence.namespace}",
        f"there is none in /dev/shm/skinware.{evidence.namespace}{told}",
        "see what is plugged in and start a driver; of one that runs, see the log, and its boards (power, bit rate)",
        (*there, "skin-find", "skin-driver --bus can0"),
        "tutorials/first-run.md",
    )


def _readers(evidence: Evidence) -> Iterator[Note]:
    for one in evidence.readers:
        yield Looked(AREA, f"reader {one.program}", f"{one.frames} frames of {one.driver} taken, {one.lost} missed")
        if one.lost:
            yield Finding(
                Severity.WARNING,
                AREA,
                "a program does not keep up with a driver whose frames it wants all",
                f"{one.program}, pid {one.pid}, reads {one.driver}",
                f"{plural(one.lost, 'frame')} missed and {one.frames} taken in {evidence.seconds:.1f} s",
                "give that program more processor time, or start the driver with more slots for frames: --slots 64",
                ("skin-info",),
                "reference/faults.md#programs",
            )


def _life(driver: DriverSeen) -> Iterator[Finding]:
    where = f"driver {driver.name}"
    ages = [patch.age_ns for patch in driver.patches if patch.age_ns is not None]
    age = f"its newest data is {age_text(min(ages))} old" if ages else "it published no data"
    if driver.life == "dead":
        yield Finding(
            Severity.ERROR,
            AREA,
            "the driver was killed",
            where,
            f"pid {driver.pid} is gone; {age}",
            "start it again; its readers go on by themselves",
            ("journalctl -b -g skin-driver",),
            "reference/faults.md#programs",
        )
    elif driver.life == "silent":
        yield Finding(
            Severity.ERROR,
            AREA,
            "the driver runs and publishes nothing",
            where,
            f"pid {driver.pid}, stopped or hung; {age}",
            "see whether it is stopped (T); end it and start it again",
            (f"ps -o pid,stat,wchan:20,args -p {driver.pid}",),
            "reference/faults.md#programs",
        )
    elif driver.life == "starting":
        yield Finding(
            Severity.WARNING,
            AREA,
            "the driver has published nothing yet",
            where,
            f"pid {driver.pid}",
            "wait; if it stays so, see its log",
            (f"skin-info {driver.name} --watch",),
        )
    elif driver.life == "paused":
        yield Finding(
            Severity.NOTE,
            AREA,
            "the driver is paused",
            where,
            f"pid {driver.pid}; {age}",
            "resume it from the program that paused it",
            (f"skin-info {driver.name}",),
        )
    if driver.restarts:
        yield Finding(
            Severity.WARNING,
            AREA,
            "the driver was started anew",
            where,
            plural(driver.restarts, "time"),
            "see its log",
            ("journalctl -b -g skin-driver",),
            "reference/faults.md#programs",
        )


def _late(driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    times, where, period = driver.timing, f"driver {driver.name}", f"period {age_text(driver.timing.period_ns)}"
    periods = evidence.seconds * NS_PER_S / times.period_ns if times.period_ns else 0
    if times.missed > _MISSED_SHARE * periods:
        yield Finding(
            Severity.WARNING,
            AREA,
            "the driver misses periods",
            where,
            f"{times.missed} of {periods:.0f} in {evidence.seconds:.1f} s; {circumstances(evidence, driver)}",
            "start it with more processor time: --realtime fifo:50",
            see=_REALTIME,
        )
    bound = times.age.quantile_ns(0.99)
    limit = max(2 * times.period_ns, _LATE_NS)
    if bound is not None and bound > 2 * limit:  # the bound is up to twice the true value
        worst = max(driver.patches, key=lambda patch: patch.delay.quantile_ns(0.99) or 0, default=None)
        told = f"; worst: {worst.name}" if worst is not None else ""
        yield Finding(
            Severity.WARNING,
            AREA,
            "data is old when it is published",
            where,
            f"99 % at most {age_text(bound)}, {period}{told}; {circumstances(evidence, driver)}",
            "start it with more processor time (--realtime fifo:50); if it waits for one patch of its cycle, with"
            " --publish rate",
            see="troubleshooting.md#data-is-missing",
        )
    if times.longest_gap_s > max(_LONG_GAP_S, 5e-9 * times.period_ns) and driver.life != "paused":
        yield Finding(
            Severity.WARNING,
            AREA,
            "nothing was published for a while",
            where,
            f"{age_text(times.longest_gap_s * 1e9)}, {period}; {circumstances(evidence, driver)}",
            "see what held the driver up: its log, and the load of the machine",
            ("journalctl -b -g skin-driver",),
            _REALTIME,
        )


def _clock(driver: DriverSeen) -> Iterator[Finding]:
    times, where = driver.timing, f"driver {driver.name}"
    if times.future_ns > _FUTURE_NS:
        yield Finding(
            Severity.WARNING,
            AREA,
            "data is stamped later than it was published",
            where,
            f"by up to {age_text(times.future_ns)}",
            "the clock of a device or controller runs ahead; start the driver without its stamps:"
            " --bus 'can0?timestamps=kernel'",
            see=_TIME,
        )
    if times.backwards:
        yield Finding(
            Severity.WARNING,
            AREA,
            "times of data went backwards",
            where,
            plural(times.backwards, "time"),
            "the clock of a device or controller was reset; if it goes on, start the driver without its stamps:"
            " --bus 'can0?timestamps=kernel'",
            see=_TIME,
        )
    if times.before_boot:
        yield Finding(
            Severity.NOTE,
            AREA,
            "data was stamped before the machine was started",
            where,
            plural(times.before_boot, "frame"),
            "a clock was set; nothing, if the number stays",
            (f"skin-info {driver.name}",),
            _TIME,
        )
