"""skinware.h refuses files and folders that are damaged or cannot be trusted."""

from __future__ import annotations

import json
import os
import random
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skinware import DriverReader, DriverWriter, Namespace
from skinware.errors import BadServiceFile
from skinware.memory import file_layout
from skinware.memory.namespace import ROOT
from tests.compiling import compiled
from tests.core.c_programs import SOURCE, STRAIN, fill, ring_file, run, structure, talking


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda d: d[:100], "shorter than a header"),
        (lambda d: b"", "shorter than a header"),
        (lambda d: d[:-4096], "truncated"),
        (lambda d: b"NOTARING" + d[8:], "wrong magic"),
        (lambda d: d[:8] + b"\x09\0\0\0" + d[12:], "layout version"),
        (lambda d: d[:44] + b"\xff\xff\0\0" + d[48:], "make no ring"),
        (lambda d: d[:48] + b"\xff" * 16 + d[64:], "make no ring"),
        (lambda d: d[:48] + b"\0\xf0" + b"\xff" * 6 + d[56:], "outside the file"),
        (lambda d: d[:56] + b"\xc0" + b"\xff" * 7 + d[64:], "outside the file"),
        (lambda d: d[:40] + b"\xff\xff\0\0" + d[44:], "columns do not fit"),
        (lambda d: d[:1152] + bytes(24) + d[1176:], "no proper name"),
        (lambda d: d[: 1152 + 24] + b"<c16" + d[1152 + 28 :], "dtype"),
        (lambda d: d[: 1152 + 32] + b"\xff" * 8 + d[1152 + 40 :], "column"),
        (lambda d: d[: 1152 + 40] + b"\xc0" + b"\xff" * 7 + d[1152 + 48 :], "begins at a wrong place"),
        (lambda d: d[:44] + b"\x01" + d[45:], "make no ring"),
        (lambda d: d[:56] + bytes(8) + d[64:], "make no ring"),
        (lambda d: d.replace(b"sensor_module", b"sensor_nodule"), "structure is missing"),
        (lambda d: d.replace(b"<u2", b"<f2"), "do not fit its structure"),
        (lambda d: d.replace(np.arange(6, dtype="<u4") % 2, np.arange(6, dtype="<u4")), "does not exist"),
        (lambda d: d.replace(STRAIN.to_bytes(4, "little"), b"\x63\0\0\0", 1), "not in the driver's table"),
    ],
)
def test_damaged_files_are_refused(
    any_program: Path, namespace: Namespace, damage: Callable[[bytes], bytes], words: str
) -> None:
    namespace.ring_path("x").write_bytes(damage(ring_file(namespace)))
    seen = run(any_program, "describe", "x")
    assert (seen["event"], seen["text"]) == ("refused", "the service's file cannot be read safely")
    assert words in seen["reason"]
    with pytest.raises(BadServiceFile):
        DriverReader("x")
    namespace.ring_path("x").unlink()


def test_a_later_minor_version_with_things_unknown_is_read(program: Path, namespace: Namespace) -> None:
    data = bytearray(ring_file(namespace))
    data[12] = 7  # minor version
    data[192:512] = b"\xaa" * 320  # what is reserved in the header
    data[524] = 0xF0  # state bits that nobody knows yet
    namespace.ring_path("x").write_bytes(data)
    seen = run(program, "describe", "x")
    assert (seen["event"], seen["sequence"]) == ("described", 3)
    with DriverReader("x") as reader:
        assert reader.read().sequence == 3
    namespace.ring_path("x").unlink()


def test_symlinks_fifos_and_foreign_files_are_refused(program: Path, namespace: Namespace) -> None:
    data = ring_file(namespace)
    path = namespace.ring_path("x")
    path.symlink_to("/etc/passwd")
    assert run(program, "describe", "x")["reason"] == "the file cannot be opened"
    path.unlink()
    os.mkfifo(path)
    assert run(program, "describe", "x")["reason"] == "not a regular file"
    path.unlink()
    if os.geteuid() == 0:
        path.write_bytes(data)
        os.chown(path, 12345, -1)
        assert "another user" in run(program, "describe", "x")["reason"]
        path.unlink()


def test_folders_that_cannot_be_trusted_are_refused(
    program: Path, namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "no driver has run" in run(program, "describe", "x")["reason"]
    namespace.create()
    assert "no such service" in run(program, "describe", "x")["reason"]
    namespace.path.chmod(0o2777)
    assert "written by others" in run(program, "describe", "x")["reason"]
    namespace.path.chmod(0o2750)
    monkeypatch.setenv("SKINWARE_OWNER", "nobody-of-that-name")
    assert "no user of this machine" in run(program, "describe", "x")["reason"]
    monkeypatch.delenv("SKINWARE_OWNER")
    if os.geteuid() == 0:
        os.chown(namespace.path, 12345, -1)
        assert "SKINWARE_OWNER" in run(program, "describe", "x")["reason"]
        monkeypatch.setenv("SKINWARE_OWNER", "12345")
        assert "no such service" in run(program, "describe", "x")["reason"]
    link = ROOT / f"{namespace.path.name}-link"
    link.symlink_to(namespace.path)
    try:
        monkeypatch.setenv("SKINWARE_NAMESPACE", f"{namespace.name}-link")
        assert "symbolic link" in run(program, "describe", "x")["reason"]
    finally:
        link.unlink()


@pytest.mark.parametrize("name", ["", "-x", "a/b", "../x", "x" * 48, "x.ring", "\u00e4"])
def test_names_that_cannot_be_are_refused(program: Path, name: str) -> None:
    assert run(program, "describe", name)["text"] == "not the name of a service or namespace"
    if name:
        result = subprocess.run(
            [program, "describe", "x"], env={**os.environ, "SKINWARE_NAMESPACE": name}, capture_output=True, text=True
        )
        assert json.loads(result.stdout)["text"] == "not the name of a service or namespace"


HEAD_BITS = 8 * (file_layout.COLUMN_OFFSET + 30 * file_layout.COLUMN.itemsize)
FLIPS = st.one_of(st.integers(0, HEAD_BITS - 1), st.integers(0, 8 * 4096 * 4))
WORDS = st.tuples(
    st.integers(0, HEAD_BITS // 32 - 1),
    st.sampled_from([0, 1, 2, 63, 64, 4095, 4096, 0x7FFF_FFFF, 0xFFFF_FFC0, 0xFFFF_FFFF]),
)


@pytest.mark.thorough
@pytest.mark.parametrize("language", ["sanitized", "sanitized copies"])
def test_damage_of_any_kind_does_no_harm(
    language: str, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(SOURCE, language, tmp_path_factory)
    data = ring_file(namespace)
    path = namespace.ring_path("x")
    attached = refused = 0
    with talking(program, "walk") as talk:

        @settings(max_examples=500, deadline=None, database=None, suppress_health_check=list(HealthCheck))
        @given(st.lists(FLIPS, max_size=4), st.lists(WORDS, max_size=3))
        def damage(flips: list[int], words: list[tuple[int, int]]) -> None:
            nonlocal attached, refused
            damaged = bytearray(data)
            for bit in flips:
                damaged[bit // 8 % len(damaged)] ^= 1 << bit % 8
            for at, value in words:
                damaged[4 * at : 4 * at + 4] = value.to_bytes(4, "little")
            path.write_bytes(damaged)
            talk.tell("x")
            if talk.next()["event"] == "attached":
                attached += 1
                file_layout.parse(bytes(damaged), "x", len(damaged))  # what C takes, Python takes
            else:
                refused += 1

        damage()
    path.unlink()
    assert attached > 20
    assert refused > 20


def test_damage_while_a_file_is_read_does_no_harm(
    namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(SOURCE, "sanitized", tmp_path_factory)
    path = namespace.ring_path("x")
    path.write_bytes(ring_file(namespace))
    size = path.stat().st_size
    generator = random.Random(7)
    fd = os.open(path, os.O_RDWR)
    try:
        with talking(program, "follow", "x", 0) as talk:
            for _ in range(1000):
                offset = generator.choice([0, 512, 1152, generator.randrange(size)])
                os.pwrite(fd, generator.randbytes(min(640, size - offset)), offset)
                talk.next()
            talk.end_input()
    finally:
        os.close(fd)
    assert path.stat().st_size == size
    path.unlink()


@pytest.mark.thorough
@pytest.mark.parametrize("language", ["c11", "c11 sanitized"])
def test_an_owner_that_changes_a_table_during_a_call_does_no_harm(
    language: str, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(SOURCE.with_name("fresh_race.c"), language, tmp_path_factory)
    with DriverWriter("x", structure()) as writer:
        fill(writer, 1)
        result = subprocess.run([program, namespace.name, "x"], capture_output=True, text=True, timeout=110)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) > 0
