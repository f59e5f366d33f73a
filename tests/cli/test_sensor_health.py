"""skin-info --health: which sensors are broken, and why."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, Namespace, ServiceWriter, Status
from skinware.cli._command import exit_status
from skinware.cli.info import command
from skinware.tactile.health import HealthKind, HealthReport
from skinware.tactile.health_service import HealthWriter
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.commands import run, running


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert exit_status(command, ["--health", "--json", *arguments]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def text(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert exit_status(command, ["--health", *arguments]) == 0
    return capsys.readouterr().out


def report_of(n: int) -> HealthReport:
    """A stuck and a noisy one, two that nobody has touched, the others good."""
    report = HealthReport.unknown(n)
    report.still_s[:] = 0.1
    report.kind[[3, 4]] = HealthKind.NEVER_TOUCHED
    report.kind[5], report.value[5], report.still_s[5] = HealthKind.STUCK, 73, 700
    report.peak[5], report.clipped[5], report.touches[5] = 0, 0, 7
    report.shown[5], report.shown_around[5] = 0.1, 1.2
    report.kind[17], report.noise[17], report.noise_times[17] = HealthKind.NOISY, 6, 7.5
    return report


@contextmanager
def looked_after(namespace: Namespace) -> Iterator[None]:
    with FakeSkin("hand") as skin, HealthWriter(skin.structure, "hand", namespace=namespace) as writer:
        skin.publish()
        writer.publish({"pressure": report_of(640)}, 1)
        with ServiceWriter("odd", {"kind": ("u1", (3,))}, kind="health", namespace=namespace):
            yield


def test_faults_are_listed_with_their_evidence(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with looked_after(namespace):
        shown = text(capsys)
        found = told(capsys)
    assert shown.splitlines()[:4] == [
        f"hand in namespace {namespace.name}: 768 sensors: 636 good, 2 never touched, 1 noisy, 1 stuck, 128 unknown",
        "  sensor                        type      fault  evidence",
        "  board 7, triangle 0, taxel 5  pressure  stuck  at 73 counts for 700 s, while its module was touched",
        "  board 7, triangle 1, taxel 7  pressure  noisy  noise 6 counts, 7.5 times that of the others",
    ]
    (entry,) = found["health"]
    assert (entry["driver"], entry["namespace"], entry["service"]) == ("hand", namespace.name, "health")
    assert entry["state"] == "live"
    assert entry["kinds"]["never_touched"] == 2
    stuck, noisy = entry["faults"]
    assert (stuck["name"], stuck["kind"], stuck["uid"]) == ("board 7, triangle 0, taxel 5", "stuck", 1005)
    assert (noisy["kind"], noisy["noise"], noisy["noise_times"], noisy["shown"]) == ("noisy", 6, 7.5, None)
    assert math.isclose(stuck["still_s"], 700)


def test_one_driver_can_be_chosen(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with looked_after(namespace):
        assert len(told(capsys, "hand")["health"]) == 1
        assert told(capsys, "arm")["health"] == []


def test_nothing_is_said_where_nobody_looks(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    here = ["--namespace", namespace.name]
    assert "skin-calm NAME" in text(capsys, *here)
    with FakeSkin() as skin, HealthWriter(skin.structure, "fake"):
        assert told(capsys, *here) == {"health": [], "problems": []}  # not yet
    assert exit_status(command, ["--health", "--watch"]) == 2
    assert "--health stands alone" in capsys.readouterr().err


def test_what_cannot_be_read_is_a_problem(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    here = ["--namespace", namespace.name]
    with ServiceWriter("odd", {"kind": ("u1", (3,))}, kind="health"):
        (problem,) = told(capsys, *here)["problems"]
        assert "not attached" in problem
        assert "problem: " in text(capsys, *here)
    with HealthWriter(fake_structure(), "gone") as writer:  # its driver is not there
        writer.publish({"pressure": report_of(640)}, 1)
        assert told(capsys, *here) == {"health": [], "problems": []}
    with FakeSkin("hand", fake_structure(1, 2)), HealthWriter(fake_structure(), "hand") as writer:
        writer.publish({"pressure": report_of(640)}, 1)
        assert told(capsys, *here) == {"health": [], "problems": []}  # its driver has just changed


@pytest.mark.thorough
def test_a_broken_taxel_of_a_real_driver_is_named(
    namespace: Namespace, calm_namespace: Namespace, tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """Out of range from the start: at an end of the range, whatever happens.

    Nobody touches the skin: what a finger holds down while it is tared jumps when that leaves, and looks noisy a while.
    """
    bus = "virtual?boards=7&out_of_range=7/3/5&pattern=idle"
    calm = ["roboskin", "--into", calm_namespace.name, "--state", str(tmp_path / "state.npz")]
    with running("skin-driver", "--bus", bus) as driver:
        driver.wait_for("ready")
        with running("skin-calm", *calm) as service:
            assert service.wait_for("ready")["health"] == "health"
            with DriverReader("roboskin", namespace=calm_namespace, timeout_s=10) as reader:
                reader.call("tare")
                frame = read_until(reader, lambda frame: bool((frame.status & Status.UNHEALTHY).any()), 60)
                (marked,) = np.flatnonzero(frame.status & Status.UNHEALTHY).tolist()
                assert frame.structure.sensor_name(marked) == "board 7, triangle 3, taxel 5"
            wait_until(lambda: bool(told(capsys, "--namespace", calm_namespace.name)["health"][0]["faults"]))
            done = run("skin-info", "--health", "--namespace", calm_namespace.name)
            assert "board 7, triangle 3, taxel 5" in done.stdout
            assert "clipped" in done.stdout
            top = run("skin-top", "--plain", "-T", "1", "--json", "--namespace", calm_namespace.name)
            assert json.loads(top.stdout.splitlines()[-1])["status"]["unhealthy"] == 1
