"""The CAN lab says that it can run only where all is there that a boot needs, and its guest never outlives it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from skinware_drivers.testing import lab
from skinware_drivers.testing.waiting import wait_until

STATIC = "ELF 64-bit LSB executable, x86-64, statically linked, stripped"
DYNAMIC = "ELF 64-bit LSB pie executable, x86-64, dynamically linked, interpreter /lib64/ld-linux-x86-64.so.2"
NEEDED = ("qemu-system-x86_64", "ip", "modprobe", "file", "busybox", "vng")


def put(path: Path, script: str) -> None:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with all the commands of a machine that can run the lab."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in NEEDED:
        put(folder / name, f'echo "$2: {STATIC}"')
    monkeypatch.setattr(lab, "_path", lambda: f"{folder}")
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setattr(lab, "find_kernel", lambda flavour: Path(f"/boot/vmlinuz-{flavour}"))
    monkeypatch.setattr(lab, "find_vng", lambda: str(folder / "vng") if (folder / "vng").exists() else None)
    return folder


@pytest.mark.usefixtures("machine")
def test_a_machine_that_has_all_can_run_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert lab.report("plain", lab.missing("plain")) == 0
    assert capsys.readouterr().out == "the CAN lab can run: /boot/vmlinuz-plain\n"


def test_user_mode_linux_needs_no_machine(machine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in set(NEEDED) - {"ip", "modprobe"}:
        (machine / name).unlink()
    put(machine / lab.USER_KERNEL, "")
    assert lab.report("user", lab.missing("user")) == 1
    assert "missing: User-Mode Linux\ninstall: apt-get install" in capsys.readouterr().err
    (machine.with_name("lib") / "uml" / "modules").mkdir(parents=True)
    assert lab.report("user", lab.missing("user")) == 0
    assert capsys.readouterr().out == "the CAN lab can run: linux.uml\n"


def test_the_status_of_a_command_in_user_mode_linux_is_its_own(machine: Path) -> None:
    (machine.with_name("lib") / "uml" / "modules").mkdir(parents=True)
    find_init = 'for word in "$@"; do case $word in init=*) place=${word#init=} ;; esac; done'
    put(machine / lab.USER_KERNEL, f"{find_init}; echo CAN lab: up; echo 3 >${{place%init}}status")
    assert lab.run("user", ["false"], 60.0, machine) == 3
    put(machine / lab.USER_KERNEL, "echo CAN lab: up; exit 0")
    assert lab.run("user", ["false"], 60.0, machine) == 1


@pytest.mark.parametrize("name", NEEDED)
def test_whatever_is_missing_is_named(machine: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    (machine / name).unlink()
    assert lab.report("rt", lab.missing("rt")) == 1
    said = capsys.readouterr().err
    assert {"vng": "virtme-ng"}.get(name, name) in said.splitlines()[0]
    assert said.splitlines()[1] == f"install: apt-get install --no-install-recommends {lab.PACKAGES['rt']}"


def test_a_dynamically_linked_busybox_is_none(machine: Path) -> None:
    put(machine / "file", f'echo "$2: {DYNAMIC}"')
    assert lab.missing("plain") == ["a statically linked busybox"]
    put(machine / "busybox-static", "")
    put(machine / "file", f'case $2 in *-static) echo "{STATIC}" ;; *) echo "{DYNAMIC}" ;; esac')
    assert lab.missing("plain") == []


@pytest.mark.parametrize("suffix", ["", ".xz", ".zst"])
def test_a_kernel_is_one_that_has_all_modules(tmp_path: Path, suffix: str) -> None:
    names = lab.MODULES.split()
    lines = [f"kernel/net/can/{name}.ko{suffix}: kernel/net/can/can.ko{suffix}\n" for name in names]
    assert not lab._has_modules(tmp_path)
    (tmp_path / "modules.dep").write_text("".join(lines))
    assert lab._has_modules(tmp_path)
    (tmp_path / "modules.dep").write_text("".join(lines[1:]))
    assert not lab._has_modules(tmp_path)


def test_the_guest_ends_with_the_lab(machine: Path) -> None:
    put(machine / "vng", 'echo CAN lab: up; echo "guest $$"; exec sleep 600')
    program = f"""
import sys
from pathlib import Path
from skinware_drivers.testing import lab
lab.missing, lab.find_kernel, lab.find_vng = lambda flavour: [], lambda flavour: Path("/"), lambda: "{machine}/vng"
sys.argv = ["lab", "run", "true"]
sys.exit(lab.main(Path("/")))
"""
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout:
        guest = int(process.stdout.readline().split()[1])
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 128 + signal.SIGTERM
    wait_until(lambda: not Path(f"/proc/{guest}").exists())


def test_a_guest_that_does_not_come_up_is_told_of(
    machine: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    put(machine / "vng", "echo BIOS; exec /bin/sleep 600")
    monkeypatch.setattr(lab, "BOOT_S", 0.5)
    assert lab.run("plain", ["true"], 60, machine) == 124
    shown = capfd.readouterr()
    assert shown.err == "CAN lab: the guest did not come up within 0.5 s\n"
    assert shown.out == "BIOS\n"
    put(machine / "vng", "echo no such processor; exit 5")
    assert lab.run("plain", ["true"], 60, machine) == 5
    assert "no such processor" in capfd.readouterr().out


def test_a_command_may_be_longer_than_a_kernels_command_line(machine: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """``--exec`` is the last argument; a kernel takes 2,048 characters in all."""
    put(machine / "vng", 'for last; do :; done; echo CAN lab: up; echo "$last"; /bin/grep -c "x x" ${last#bash }')
    assert lab.run("plain", ["echo", *["x"] * 5000], 60, machine) == 0
    last, found = capfd.readouterr().out.splitlines()
    assert len(last) < 200
    assert found == "1"
    assert not Path(last.removeprefix("bash ")).exists()
