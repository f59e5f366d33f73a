"""Programs: drivers that hang or are late, their clocks, readers that do not keep up, bridges, and files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from skinware.bridge_state import as_data, summary
from skinware.realtime import NS_PER_S
from skinware.text import age_text, count_text, plural, rate_text
from skinware_drivers.doctor.evidence import DriverSeen, Evidence, RecordingSeen
from skinware_drivers.doctor.rules import RULES, Finding, Looked, Note, circumstances

_LATE_NS = 50_000_000
"""Age of data when it is published, from which it is late whatever its period."""
_FUTURE_NS = 1_000_000
_LONG_GAP_S = 1.0
_MISSED_SHARE = 0.01
"""Share of the periods that a busy machine may cost."""
_SET_S = 0.1
_LOST_SHARE = 0.05
"""Share of the snapshots that a link may skip without a note."""
_MIB = 1 << 20
_MOST_COMMANDS = 3


def check_timing(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        yield Looked(f"driver {driver.name}", _driver_as_seen(driver, evidence))
        yield from _life(driver)
        if driver.life != "dead":
            yield from _late(driver, evidence)
        times, where, rules = driver.timing, f"driver {driver.name}", RULES["driver"]
        if times.future_ns > _FUTURE_NS:
            yield rules["ahead"].found(where, f"by up to {age_text(times.future_ns)}")
        if times.backwards:
            yield rules["backwards"].found(where, plural(times.backwards, "time"))
        if times.before_boot:
            yield rules["before-boot"].found(where, plural(times.before_boot, "frame"), driver=driver.name)
    for one in evidence.readers:
        yield Looked(f"reader {one.program}", f"{one.frames} snapshots of {one.driver} taken, {one.missed} missed")
        if one.missed:
            yield RULES["driver"]["slow-reader"].found(
                f"{one.program}, pid {one.pid}, reads {one.driver}",
                f"{plural(one.missed, 'snapshot')} missed and {one.frames} taken in {evidence.seconds:.1f} s",
            )
    if evidence.is_live:
        if not evidence.drivers:
            seen = f"there is none in /dev/shm/skinware.{evidence.namespace}"
            if evidence.running:
                seen += f"; running now: {', '.join(map(str, evidence.running))}"
            if evidence.waiting:
                pids = ", ".join(map(str, evidence.waiting))
                seen += f"; skin-driver runs (pid {pids}), and has found no device so far"
            running = {"running": evidence.running[0].namespace} if evidence.running else {}
            yield RULES["driver"]["none"].found(f"namespace {evidence.namespace}", seen, **running)
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
    if driver.life in seen:
        yield RULES["life"][driver.life].found(where, seen[driver.life], driver=driver.name, pid=driver.pid)
    if driver.restarts:
        yield RULES["driver"]["restarted"].found(where, plural(driver.restarts, "time"))


def _late(driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    times, where, period = driver.timing, f"driver {driver.name}", f"period {age_text(driver.timing.period_ns)}"
    why, rules = circumstances(evidence, driver), RULES["driver"]
    periods = evidence.seconds * NS_PER_S / times.period_ns if times.period_ns else 0
    if times.missed > _MISSED_SHARE * periods:
        seen = f"{times.missed} of {periods:.0f} in {evidence.seconds:.1f} s; {why}"
        yield rules["missed"].found(where, seen)
    bound = times.age.quantile_ns(0.99)
    limit = max(2 * times.period_ns, _LATE_NS)
    if bound is not None and bound > 2 * limit:  # the bound is up to twice the true value
        worst = max(driver.patches, key=lambda patch: patch.delay.quantile_ns(0.99) or 0, default=None)
        which = f"; worst: {worst.name}" if worst is not None else ""
        yield rules["old"].found(where, f"99 % at most {age_text(bound)}, {period}{which}; {why}")
    if times.longest_gap_s > max(_LONG_GAP_S, 5e-9 * times.period_ns) and driver.life != "paused":
        yield rules["gap"].found(where, f"{age_text(times.longest_gap_s * 1e9)}, {period}; {why}")


def check_bridges(evidence: Evidence) -> Iterator[Note]:
    rules = RULES["bridge"]
    for bridge in evidence.bridges:
        where, state = f"robot {bridge.robot}", summary(bridge.robot, as_data(bridge))
        yield Looked(where, state)
        if not bridge.is_up:
            yield rules["not-heard"].found(where, state)
        for name, service in bridge.services.items():
            all_hz = service.rate_hz + service.gap_hz
            if service.state == "live" and service.gap_hz > _LOST_SHARE * all_hz and service.age_p50_ns is not None:
                rates = f"{rate_text(service.rate_hz)} of {rate_text(all_hz)} come"
                seen = f"{rates}, {age_text(service.age_p50_ns)} old (p50)"
                yield rules["slow"].found(f"{name} of robot {bridge.robot}", seen)
        if bridge.refused:
            seen = f"{count_text(bridge.refused)} so far; the last: {bridge.last_refused}"
            yield rules["refused"].found(where, seen)
        if bridge.namesakes or bridge.switches:
            followed = f"bridge {bridge.instance[:8]}{' on ' if bridge.host else ''}{bridge.host} is followed"
            others = f"{bridge.namesakes} other now, {bridge.switches} switches between robots so far"
            yield rules["namesakes"].found(where, f"{followed}; {others}")


def check_files(evidence: Evidence) -> Iterator[Note]:
    namespace = evidence.files
    if namespace is not None:
        where = f"namespace {namespace.name}"
        if not namespace.problem:
            services = plural(len(namespace.living), "service")
            yield Looked(where, f"{services} alive, {len(namespace.dead)} dead")
        for error in namespace.damaged:
            yield RULES["file"]["unreadable"].found(where, error, path=namespace.path)
        drivers = {driver.name for driver in evidence.drivers}  # killed ones are another finding
        dead = [name for name in namespace.dead if name not in drivers]
        if dead:
            found = RULES["file"]["left"].found(
                where,
                f"{', '.join(dead)}: {namespace.bytes_of_dead / _MIB:.1f} MiB of shared memory",
                files=plural(len(dead), "file"),
                are="are" if len(dead) > 1 else "is",
            )
            yield replace(found, commands=tuple(f"rm {namespace.path}/{name}.ring" for name in dead[:_MOST_COMMANDS]))
    if evidence.recording is not None:
        yield from _recording(evidence.recording)


def _recording(recording: RecordingSeen) -> Iterator[Note]:
    name, rules = recording.name, RULES["recording"]
    whole = "closed in good order" if recording.is_whole else "not closed in good order"
    services = f"; services {', '.join(recording.services)}" if recording.services else ""
    length = f"{recording.size / _MIB:.1f} MiB, {age_text(recording.duration_s * 1e9)}"
    yield Looked(name, f"{length}, {whole}{services}")
    if not recording.is_whole:
        why = "its index is missing: the recorder was killed, the disk was full, or the end of the file is lost"
        yield rules["cut"].found(name, why, file=name)
    for problem in recording.problems:
        yield rules["damaged"].found(name, problem, file=name)
    if recording.missed:
        yield rules["missed"].found(name, f"{plural(recording.missed, 'sample')} published meanwhile are not in it")
    for time_s, by_s in recording.clock_sets:
        yield rules["clock-set"].found(f"{name} at {age_text(time_s * 1e9)}", f"by {by_s:+.2f} s")
    if recording.boots > 1:
        yield rules["boots"].found(name, f"{recording.boots} starts, and times of data count from each")
    if recording.events.get("unreadable"):
        seen = f"{count_text(recording.events['unreadable'])} events of it"
        yield rules["unreadable-service"].found(name, seen)
