"""Profiles, lists of CPUs, periods. What a profile does to a process is tried in processes of their own."""

from __future__ import annotations

import os
import pwd

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S, Periodic, Profile, cpus_as_text, cpus_from_text, now_ns, online_cpus, set_cpus
from tests.apply_profile import LATER_KIB, command, result_of
from tests.scheduling import may_have_fifo
from tests.unprivileged import without_rights

NORMAL, FIFO_50 = [os.SCHED_OTHER, 0], [os.SCHED_FIFO, 50]
needs_rights = pytest.mark.skipif(not may_have_fifo(50), reason="this user may not have SCHED_FIFO and locked memory")


@pytest.mark.thorough
def test_normal_needs_no_rights() -> None:
    cpu = max(os.sched_getaffinity(0))
    told, warnings = result_of(without_rights(*command("normal", cpus=str(cpu), strict=True)))
    assert (told["error"], told["refused"], warnings) == ("", [], [])
    assert (told["policy"], told["cpus"], told["timer_slack_ns"]) == (NORMAL, [cpu], 1)
    assert told["locked_kib"] == 0
    assert told["frozen"] > 1000


@pytest.mark.thorough
@needs_rights
def test_fifo_gets_all_it_asks_for() -> None:
    cpu = min(os.sched_getaffinity(0))
    told, warnings = result_of(command("fifo:50", cpus=str(cpu), strict=True))
    assert (told["error"], told["refused"], warnings) == ("", [], [])
    assert (told["policy"], told["cpus"]) == (FIFO_50, [cpu])
    assert told["locked_kib"] > LATER_KIB
    assert told["frozen"] > 1000


@pytest.mark.thorough
def test_without_rights_each_refusal_is_one_line_and_the_rest_is_done() -> None:
    cpu = min(os.sched_getaffinity(0))
    told, warnings = result_of(without_rights(*command("fifo:50", cpus=str(cpu))))
    user = pwd.getpwuid(os.getuid()).pw_name
    limits = "/etc/security/limits.d/skinware.conf and log in again (services, containers: see"
    limits += ' "Keep a loop on time" in the documentation)'
    memory = "locked memory refused: RLIMIT_MEMLOCK is 64 KiB, not unlimited, without CAP_IPC_LOCK"
    policy = "SCHED_FIFO priority 50 refused: RLIMIT_RTPRIO is 0 without CAP_SYS_NICE"
    assert warnings == [
        f"{memory}; put '{user} - memlock unlimited' into {limits}",
        f"{policy}; put '{user} - rtprio 50' into {limits}",
    ]
    assert told["refused"] == warnings
    assert (told["policy"], told["cpus"], told["timer_slack_ns"]) == (NORMAL, [cpu], 1)
    assert (told["locked_kib"], told["later_kib"]) == (0, LATER_KIB)
    assert told["frozen"] > 1000


@pytest.mark.thorough
def test_strict_raises_what_would_have_been_warnings() -> None:
    going_on, _ = result_of(without_rights(*command("fifo:50")))
    told, warnings = result_of(without_rights(*command("fifo:50", strict=True)))
    assert len(going_on["refused"]) == 2
    assert told["error"].splitlines() == going_on["refused"]
    assert warnings == []
    assert (told["policy"], told["timer_slack_ns"]) == (NORMAL, 1)


def test_refused_cpus_leave_the_old_ones() -> None:
    before = os.sched_getaffinity(0)
    refusal = set_cpus({1000})
    assert refusal is not None
    allowed = ",".join(map(str, sorted(before)))
    assert str(refusal).startswith("CPUs 1000 refused: outside the CPU set of this process's container or service")
    assert cpus_from_text(refusal.why.rpartition(" ")[2]) == cpus_from_text(allowed)
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "give normal or fifo:PRIORITY"),
        ("fifo", "give normal or fifo:PRIORITY"),
        ("fifo:", "give normal or fifo:PRIORITY"),
        ("fifo:-1", "give normal or fifo:PRIORITY"),
        ("fifo:5 ", "give normal or fifo:PRIORITY"),
        ("FIFO:50", "give normal or fifo:PRIORITY"),
        ("rr:50", "real-time profile 'rr:50'"),
        ("fifo:0", "give 1 \\(lowest\\) to 99"),
        ("fifo:100", "give 1 \\(lowest\\) to 99"),
    ],
)
def test_wrong_profiles_are_refused(text: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Profile.from_text(text)


def test_profiles_that_contradict_themselves_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="normal scheduling has none"):
        Profile(priority=50)
    with pytest.raises(ConfigurationError, match="'rr'"):
        Profile(policy="rr")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="timer slack of 0 ns"):
        Profile(timer_slack_ns=0)
    with pytest.raises(ConfigurationError, match=f"CPU 99999 is not there; this machine has {online_cpus()[0]}"):
        Profile.normal(cpus=[99999])
    with pytest.raises(ConfigurationError, match="CPU -1 is not there"):
        Profile.fifo(50, cpus=[-1])


def test_profiles_from_text_are_those_from_calls() -> None:
    cpu = online_cpus()[0]
    assert Profile.from_text("normal") == Profile.normal() == Profile()
    assert Profile.from_text("fifo:7", cpus=[cpu]) == Profile.fifo(7, cpus=[cpu])
    assert Profile.fifo(7).lock_memory
    assert not Profile.normal().lock_memory


@pytest.mark.parametrize(
    ("text", "cpus"), [("1", (1,)), ("1,2-3", (1, 2, 3)), (" 3 - 4 , 0", (0, 3, 4)), ("2,1-2", (1, 2))]
)
def test_lists_of_cpus(text: str, cpus: tuple[int, ...]) -> None:
    assert cpus_from_text(text) == cpus


@pytest.mark.parametrize("text", ["", ",", "1,", "a", "-1", "1-", "3-1", "1.0", "0x1", "1 2", "\u0661", "999999"])
def test_what_is_no_list_of_cpus_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="CPUs "):
        cpus_from_text(text)


@given(st.sets(st.integers(0, 4095), min_size=1))
def test_lists_of_cpus_survive_their_text(cpus: set[int]) -> None:
    assert cpus_from_text(cpus_as_text(cpus)) == tuple(sorted(cpus))


def test_deadlines_do_not_drift() -> None:
    timer = Periodic(1000, start_ns=0)
    for period in range(1, 1001):
        assert timer.deadline_ns == period * 1_000_000
        timer.advance(timer.deadline_ns + period * 999)  # late by up to a whole period, and no more
    assert timer.missed == 0


def test_missed_periods_are_counted_and_not_caught_up_with() -> None:
    timer = Periodic(100, start_ns=0)
    timer.advance(35_000_000)
    assert (timer.missed, timer.deadline_ns) == (2, 40_000_000)
    timer.advance(40_000_000)
    assert (timer.missed, timer.deadline_ns) == (2, 50_000_000)


def test_a_wait_ends_at_its_deadline_not_before() -> None:
    timer = Periodic(100)
    for _ in range(5):
        deadline_ns = timer.deadline_ns
        assert timer.wait()
        assert now_ns() >= deadline_ns
        assert timer.deadline_ns > deadline_ns


def test_a_wait_ends_when_it_is_stopped() -> None:
    timer = Periodic(0.001)
    deadline_ns = timer.deadline_ns
    answers = iter([False, True])
    assert not timer.wait(lambda: next(answers))
    assert timer.deadline_ns == deadline_ns
    assert now_ns() < deadline_ns - 100 * NS_PER_S


def test_a_loop_counts_its_periods() -> None:
    timer = Periodic(1000, start_ns=now_ns() - NS_PER_S)
    assert [count for count, _ in zip(timer, range(3), strict=False)] == [0, 1, 2]
    assert timer.missed >= 999


@pytest.mark.parametrize("rate_hz", [0, -1, 100_001, float("nan"), float("inf")])
def test_rates_that_cannot_be_are_refused(rate_hz: float) -> None:
    with pytest.raises(ConfigurationError, match="Hz"):
        Periodic(rate_hz)
