"""The example of a C program that reads contacts, compiled and run."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from skinware import Namespace
from skinware.realtime import now_ns
from skinware.service import ServiceWriter
from skinware.tactile.contacts_service import ContactsWriter
from tests.compiling import compiled
from tests.core.test_c_how_to import lines_of
from tests.tactile.skins import AT_ONCE, triangles
from tests.tactile.test_contacts_service import structure

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.thorough
@pytest.mark.parametrize("language", ["c99", "c++11"])
def test_a_c_program_reads_contacts_over_a_change_of_the_skin(
    language: str, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(EXAMPLES / "contacts.c", language, tmp_path_factory)

    def publish(writer: ContactsWriter, n: int, **loads: float) -> None:
        value = [loads.get(f"t{taxel}", 0.0) for taxel in range(n)]
        writer.publish(np.array(value), np.array(value) > 0, now_ns())

    def at(taxel: int) -> str:
        x, y, z = triangles(20, 20)[taxel].astype(np.float32).tolist()
        return f"{x:.3f} {y:.3f} {z:.3f} m"

    with ContactsWriter(structure(), tracking=AT_ONCE, namespace=namespace, rate_hz=0.1) as writer:
        publish(writer, 400, t45=20.0)
        with lines_of(program, namespace.name) as lines:
            assert [next(lines), next(lines)] == ["1 contacts\n", f"  1: load 20 at {at(45)}\n"]
            publish(writer, 400, t45=30.0, t390=5.5)
            seen = [next(lines) for _ in range(3)]
            assert seen == ["2 contacts\n", f"  1: load 30 at {at(45)}\n", f"  2: load 5.5 at {at(390)}\n"]
            publish(writer, 400)
            assert next(lines) == "0 contacts\n"
            writer.go_on(structure(rows=3))
            publish(writer, 60, t7=4.0)
            assert [next(lines), next(lines)] == ["1 contacts\n", f"  1: load 4 at {at(7)}\n"]


@pytest.mark.parametrize("language", ["c99", "c++11"])
def test_a_reflex_in_c_acts_on_an_onset(
    language: str, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(EXAMPLES / "reflex.c", language, tmp_path_factory)
    with onset(namespace), lines_of(program, namespace.name) as lines:
        check(next(lines))


def test_a_reflex_in_python_acts_on_an_onset(namespace: Namespace) -> None:
    words = [sys.executable, str(EXAMPLES / "reflex.py"), namespace.name]
    with (
        onset(namespace),
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process,
    ):
        assert process.stdout is not None
        try:
            check(process.stdout.readline())
        finally:
            process.send_signal(signal.SIGINT)


def test_a_reflex_stops_the_joints_of_a_hand(namespace: Namespace) -> None:
    words = [sys.executable, str(EXAMPLES / "reflex.py"), namespace.name, "joints"]
    held: list[str] = []

    def hold() -> None:
        """Stop."""
        held.append("held")

    operations = {"hold": hold}
    with (
        ServiceWriter("joints", {"target": (np.float64, 1)}, namespace=namespace, operations=operations) as joints,
        onset(namespace),
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process,
    ):
        assert process.stdout is not None
        joints.begin()
        joints.commit(now_ns())
        try:
            while not held:
                joints.answer_requests(0.1)
            check(process.stdout.readline())
        finally:
            process.send_signal(signal.SIGINT)
    assert held == ["held"]


@contextmanager
def onset(namespace: Namespace) -> Iterator[None]:
    """A service with a provisional contact."""
    with ContactsWriter(structure(), namespace=namespace, rate_hz=0.1) as writer:
        writer.publish(np.zeros(400), np.zeros(400, bool), now_ns(), onset=np.arange(400) == 45)
        yield


def check(line: str) -> None:
    words = line.split()
    assert words[:2] == ["onset", "1"]
    assert words[3] == "us"
