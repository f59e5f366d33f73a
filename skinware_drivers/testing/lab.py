"""The CAN lab: a virtual machine with CAN over this machine's own files, for a kernel without CAN.

    python -m skinware_drivers.testing.lab check                  list what is missing; exit status 1 if anything is
    python -m skinware_drivers.testing.lab packages               list the Debian packages that it needs
    python -m skinware_drivers.testing.lab run [-T S] -- COMMAND  run COMMAND in this folder, and exit with its status
    python -m skinware_drivers.testing.lab --kernel rt ...        the same with a PREEMPT_RT kernel
    python -m skinware_drivers.testing.lab --kernel user ...      the same with User-Mode Linux

The guest reads this machine's files; its own files end with it. It has vcan, and two emulated CAN controllers on one
wire: can0 and can1. SKINWARE_CAN_LAB is 1 inside, and SKINWARE_CAN_LAB_KERNEL names the kernel. The processor is
emulated, so that times mean nothing. User-Mode Linux emulates no processor, boots in three seconds and has vcan alone.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

MODULES = "can-raw vcan vxcan slcan can-gw kvaser_pci"
CONTROLLERS = "-object can-bus,id=canbus0" + " -device kvaser_pci,canbus=canbus0" * 2
FILES = (
    "-fsdev local,id=lab-files,path=/,security_model=none,readonly=on,multidevs=remap"
    " -device virtio-9p-pci,fsdev=lab-files,mount_tag=lab-files"
)
"""This machine's files with a cache: virtme-ng mounts them without one, which makes Python start three times slower."""
BOOT_S = 300.0
"""Time for a boot, ten times the usual."""
UP = b"CAN lab: up\n"
"""Printed by the guest after its boot."""
MACHINE = "qemu-system-x86 {image} iproute2 kmod busybox-static file"
PACKAGES = {
    "plain": MACHINE.format(image="linux-image-amd64"),
    "rt": MACHINE.format(image="linux-image-rt-amd64"),
    "user": "user-mode-linux iproute2 kmod",
}
"""Kernels to choose from, and the Debian packages that the lab needs with them."""
USER_KERNEL = "linux.uml"


def find_kernel(flavour: str) -> Path | None:
    """Return the newest installed kernel of a flavour that has all modules of the lab."""
    kernels = [
        Path("/boot") / f"vmlinuz-{folder.name}" for folder in Path("/lib/modules").glob("*") if _has_modules(folder)
    ]
    present = [kernel for kernel in kernels if kernel.exists() and ("-rt-" in kernel.name) == (flavour == "rt")]
    return max(present, key=lambda kernel: [int(part) for part in re.findall(r"\d+", kernel.name)], default=None)


def _has_modules(folder: Path) -> bool:
    try:
        known = (folder / "modules.dep").read_text()
    except OSError:
        return False
    return all(f"/{module}.ko" in known for module in MODULES.split())


def find_user_modules() -> Path | None:
    """Return the folder of User-Mode Linux' modules, ``../lib`` of its command's; None: it is not installed."""
    kernel = _which(USER_KERNEL)
    folder = Path(kernel or "/").absolute().parent.parent / "lib" / "uml" / "modules"
    return folder if kernel and folder.is_dir() else None


def find_vng() -> str | None:
    """Return the command of virtme-ng, beside this Python or on the path."""
    return shutil.which("vng", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")


def find_busybox() -> str | None:
    """Return a statically linked busybox, which virtme-ng boots the guest with, if there is one."""
    for name in ("busybox-static", "busybox.static", "busybox"):
        if busybox := _which(name):
            kind = subprocess.run(["file", "-L", busybox], capture_output=True, text=True).stdout
            return busybox if "statically linked" in kind or "static-pie linked" in kind else None
    return None


def missing(flavour: str) -> list[str]:
    """Return what this machine lacks, a line each; empty if the lab can run."""
    commands = ("ip", "modprobe") if flavour == "user" else ("ip", "modprobe", "file")  # virtme-ng uses the last
    lacks = [f"the command {name}" for name in commands if _which(name) is None]
    if flavour == "user":
        return lacks + ([] if find_user_modules() else ["User-Mode Linux"])
    if _which("qemu-system-x86_64") is None:
        lacks.append("qemu-system-x86_64")
    if find_kernel(flavour) is None:
        kind = "a PREEMPT_RT kernel" if flavour == "rt" else "a kernel"
        lacks.append(f"{kind} with CAN modules in /boot and /lib/modules")
    if _which("file") is None or find_busybox() is None:
        lacks.append("a statically linked busybox")
    if find_vng() is None:
        lacks.append("virtme-ng (pip install virtme-ng)")
    return lacks


def _which(command: str) -> str | None:
    return shutil.which(command, path=_path())


def _path() -> str:
    return os.environ.get("PATH", "") + ":/usr/sbin:/sbin"


def guest_script(flavour: str, command: list[str], folder: Path) -> str:
    """Return the script that the guest runs."""
    modules = MODULES
    mount_files = """
        mountpoint -q /dev/shm || mount -t tmpfs tmpfs /dev/shm
        mkdir /run/lab && mount -t tmpfs tmpfs /run/lab && cd /run/lab && mkdir files new work all
        mount -t 9p -o ro,trans=virtio,version=9p2000.L,cache=loose,msize=512000 lab-files files
        mount -t overlay -o lowerdir=files,upperdir=new,workdir=work overlay all
        for folder in proc sys dev run; do mount --rbind /$folder all/$folder; done
    """
    if flavour == "user":
        modules = MODULES.replace(" kvaser_pci", "")
        mount_files = f"""
        mount -t proc proc /proc && mount -t sysfs sys /sys && mount -t tmpfs tmpfs /run
        modules={find_user_modules()}/$(uname -r)
        insmod $modules/kernel/fs/overlayfs/overlay.ko
        cd /run && mkdir new work all
        mount -t overlay -o lowerdir=/,upperdir=new,workdir=work overlay all
        mount -t devtmpfs dev all/dev && mkdir -p all/dev/shm all/dev/pts all/lib/modules/$(uname -r)
        mount --bind $modules all/lib/modules/$(uname -r)
        mount -t devpts -o ptmxmode=666 devpts all/dev/pts
        for folder in dev/shm run; do mount -t tmpfs tmpfs all/$folder; done
        for folder in proc sys; do mount --rbind /$folder all/$folder; done
    """
    within = f"""
        set -e
        modprobe -a {modules}
        echo 100000 >/proc/sys/net/core/netdev_max_backlog
        ip link set lo up
        cd {shlex.quote(str(folder))} && exec {shlex.join(command)}
    """
    return f"""
        set -e
        export PATH={shlex.quote(_path())} SKINWARE_CAN_LAB=1 SKINWARE_CAN_LAB_KERNEL={flavour}
        export PYTHONDONTWRITEBYTECODE=1 HOME=/tmp HYPOTHESIS_STORAGE_DIRECTORY=/tmp/hypothesis
        {mount_files}
        echo CAN lab: up
        exec chroot all bash -c {shlex.quote(within)}
    """


def run(flavour: str, command: list[str], timeout_s: float, folder: Path) -> int:
    """Boot the guest, run a command in it, and stop the guest.

    Args:
        flavour: of the kernel, a key of ``IMAGES``.
        timeout_s: time after which the guest is stopped.

    Returns:
        The command's exit status; 1 if the lab cannot run here; 124 after the timeout, or if the guest does not boot.
    """
    lacks = missing(flavour)
    if lacks:
        return report(flavour, lacks)
    with tempfile.TemporaryDirectory(prefix="skinware-lab-") as place:
        # in a file: a kernel takes 2,048 characters from its command line, and hangs without the rest
        script = Path(place) / "guest"
        script.write_text(guest_script(flavour, command, folder))
        if flavour == "user":
            return _run_in_user_mode(script, timeout_s)
        vng = find_vng() or ""
        # an emulated processor: slow, but there is none that it does not run on (KVM within a guest is often broken)
        arguments = [vng, "--run", str(find_kernel(flavour)), "--disable-kvm", "--force-9p", "--disable-microvm"]
        arguments += ["--cpus", "2", "--memory", "2G", f"--qemu-opts={CONTROLLERS} {FILES}"]
        environment = {**os.environ, "PATH": f"{Path(vng).parent}{os.pathsep}{_path()}"}  # vng calls its neighbours
        return boot([*arguments, "--exec", f"bash {shlex.quote(str(script))}"], environment, timeout_s)


def _run_in_user_mode(script: Path, timeout_s: float) -> int:
    """Boot User-Mode Linux, whose own exit status says nothing: the guest writes the command's into a file."""
    place, status, first = script.parent, script.with_name("status"), script.with_name("init")
    first.write_text(f"""#!/bin/bash
        exec >/dev/console 2>&1
        stty -onlcr </dev/console
        PATH={shlex.quote(_path())}
        bash {script}
        code=$?
        (mount -t hostfs -o hostfs={place} none /mnt || mount -t hostfs -o {place} none /mnt) 2>/dev/null
        echo $code >/mnt/{status.name} # Linux 6.12 wants the name of the option, 6.1 refuses it
        echo o >/proc/sysrq-trigger
        sleep 60
    """)
    first.chmod(0o755)
    kernel = [_which(USER_KERNEL) or "", "rootfstype=hostfs", "rootflags=/", "ro", "mem=2G", f"init={first}"]
    booted = boot(
        [*kernel, "con=null", "con0=null,fd:1", "seccomp=auto", "quiet"],
        {**os.environ, "TMPDIR": str(place)},
        timeout_s,
    )
    return int(status.read_text()) if status.exists() else booted or 1


def boot(arguments: list[str], environment: dict[str, str], timeout_s: float) -> int:
    """Boot the guest, wait for its end, and return the command's exit status, or 124."""
    is_up = threading.Event()
    with subprocess.Popen(
        arguments,
        start_new_session=True,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,  # QEMU would open a file again and overwrite it
        stderr=subprocess.STDOUT,
    ) as process:
        relay = threading.Thread(target=copy_output, args=(process, is_up), daemon=True)
        try:  # a signal to end may come at any moment
            relay.start()
            if not is_up.wait(min(BOOT_S, timeout_s)):
                sys.stderr.write(f"CAN lab: the guest did not come up within {min(BOOT_S, timeout_s):g} s\n")
                return 124
            return process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            sys.stderr.write(f"CAN lab: the guest was still running after {timeout_s:g} s and was stopped\n")
            return 124
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            if relay.is_alive():
                relay.join()


def copy_output(process: subprocess.Popen[bytes], is_up: threading.Event) -> None:
    """Copy the guest's output from the end of its boot on; if the boot fails, print the output before."""
    before = b""
    while process.stdout is not None and (data := os.read(process.stdout.fileno(), 65536)):
        if not is_up.is_set():
            before, found, data = (before + data).partition(UP)
            if not found:
                continue
            is_up.set()
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()
    if not is_up.is_set():
        sys.stdout.buffer.write(before)
        is_up.set()  # it has ended


def report(flavour: str, lacks: list[str]) -> int:
    """Print what is missing and how to install it; return the exit status."""
    if not lacks:
        sys.stdout.write(f"the CAN lab can run: {USER_KERNEL if flavour == 'user' else find_kernel(flavour)}\n")
        return 0
    sys.stderr.write(
        f"the CAN lab cannot run here; missing: {', '.join(lacks)}\n"
        f"install: apt-get install --no-install-recommends {PACKAGES[flavour]}\n"
    )
    return 1


def main(folder: Path) -> int:
    """Run the command line; commands run in ``folder``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", choices=PACKAGES, default="plain", help="which kernel to boot (default: plain)")
    actions = parser.add_subparsers(dest="action", required=True)
    actions.add_parser("check")
    actions.add_parser("packages")
    running = actions.add_parser("run")
    running.add_argument("-T", "--timeout", type=float, default=1800.0, help="seconds before the guest is stopped")
    running.add_argument("command", nargs="+")
    arguments = parser.parse_args()
    if arguments.action == "check":
        return report(arguments.kernel, missing(arguments.kernel))
    if arguments.action == "packages":
        sys.stdout.write(f"{PACKAGES[arguments.kernel]}\n")
        return 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # the guest ends with us
    return run(arguments.kernel, arguments.command, arguments.timeout, folder)


if __name__ == "__main__":
    sys.exit(main(Path.cwd()))
