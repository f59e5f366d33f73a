"""Real-time profiles on the lab's kernels: what the kernel then says of a running driver, and who is refused what.

The lab's processor is emulated: that a profile holds is proven there, not what it does to lateness.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skinware import DriverReader
from tests import scheduling
from tests.apply_profile import LATER_KIB, command, result_of
from tests.commands import running
from tests.unprivileged import without_rights

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]

NORMAL, FIFO_50 = [os.SCHED_OTHER, 0], [os.SCHED_FIFO, 50]
UNLIMITED = -1
CPUS = sorted(os.sched_getaffinity(0))
KERNEL = os.environ.get("SKINWARE_CAN_LAB_KERNEL")

needs_lab = pytest.mark.skipif(KERNEL is None, reason="only the CAN lab's root may do all that this needs")


@needs_lab
def test_the_kernel_is_the_one_that_was_asked_for() -> None:
    """Linux has /sys/kernel/realtime only where it is built with PREEMPT_RT."""
    sign = Path("/sys/kernel/realtime")
    if KERNEL == "rt":
        assert sign.read_text().strip() == "1"
        assert "PREEMPT_RT" in os.uname().version
    else:
        assert not sign.exists()


def test_a_driver_under_fifo_holds_it_and_publishes(vcan: Callable[[], str]) -> None:
    bus = vcan()
    with running("skin-emulate", "--bus", bus, "--boards", "7", "--pattern", "cycle") as emulator:
        emulator.wait_for("ready")
        with running(
            "skin-driver", "--bus", bus, "--realtime", "fifo:50", "--cpus", str(CPUS[-1]), "--slots", "64"
        ) as driver:
            driver.wait_for("ready")
            process = driver.process.pid
            assert scheduling.policy(process) == (os.SCHED_FIFO, 50)
            assert os.sched_getaffinity(process) == {CPUS[-1]}
            assert scheduling.locked_kib(process) > 10_000
            with DriverReader("roboskin", timeout_s=60) as reader:
                frames = reader.in_order(timeout_s=60)
                for _ in range(40):
                    next(frames)
            assert scheduling.policy(process) == (os.SCHED_FIFO, 50)
            stopped = driver.stop()
    assert "refused" not in driver.errors
    assert stopped["buses"][0]["dropped"] == 0


def test_the_normal_profile_holds() -> None:
    told, warnings = result_of(command("normal", cpus=",".join(map(str, CPUS)), strict=True))
    assert (told["error"], warnings) == ("", [])
    assert (told["policy"], told["cpus"], told["timer_slack_ns"]) == (NORMAL, CPUS, 1)
    assert told["locked_kib"] == 0


@needs_lab
def test_limits_are_enough_without_capabilities() -> None:
    told, warnings = result_of(without_rights(*command("fifo:50", strict=True), rtprio=50, memlock=UNLIMITED))
    assert (told["error"], told["refused"], warnings) == ("", [], [])
    assert told["policy"] == FIFO_50
    assert told["locked_kib"] > LATER_KIB


@needs_lab
def test_limits_that_are_too_low_are_named() -> None:
    told, (memory, policy) = result_of(without_rights(*command("fifo:50"), rtprio=49, memlock=1 << 40))
    assert "RLIMIT_MEMLOCK is 1073741824 KiB, not unlimited" in memory  # however large: later memory could exceed it
    assert "RLIMIT_RTPRIO is 49" in policy
    assert told["policy"] == NORMAL
    assert told["locked_kib"] == 0


@pytest.fixture
def one_cpu_group() -> Iterator[Path]:
    """A control group that may use CPU 0 alone."""
    root = Path("/tmp/control-groups")
    root.mkdir()
    subprocess.run(["mount", "-t", "cgroup2", "none", root], check=True)
    group = root / "one-cpu"
    try:
        (root / "cgroup.subtree_control").write_text("+cpuset")
        group.mkdir()
        (group / "cpuset.cpus").write_text("0")
        yield group
        group.rmdir()
    finally:
        subprocess.run(["umount", root], check=True)
        root.rmdir()


@needs_lab
def test_cpus_outside_the_control_group_are_refused(one_cpu_group: Path) -> None:
    """The kernel itself refuses only those who ask for none of the group's CPUs; the others get fewer in silence."""
    into_group = ["sh", "-c", f'echo $$ > {one_cpu_group}/cgroup.procs && exec "$@"', "sh"]
    told, (warning,) = result_of([*into_group, *command("fifo:50", cpus="0-1")])
    assert "outside the CPU set of this process's container or service, which may use 0;" in warning
    assert told["refused"] == [warning]
    assert told["cpus"] == [0]
    assert told["policy"] == FIFO_50
