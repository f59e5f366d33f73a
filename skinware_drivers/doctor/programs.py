"""Programs of this machine: those that read drivers, and drivers that have found nothing yet."""

from __future__ import annotations

from pathlib import Path

from skinware.memory.announcement import ReaderRecord, living_readers
from skinware.memory.namespace import Namespace
from skinware_drivers.doctor.evidence import ReaderSeen

_EVERY_FRAME = "in order"
"""How readers read that want every frame; others are meant to skip some."""
_DRIVER, _SECOND_HAND = "skin-driver", ("skin-calm", "skin-replay", "skin-bridge")
_PROC = Path("/proc")


class ReadersWatch:
    """Looks at the programs that read the drivers of a namespace: now, and at the end of the watch.

    Args:
        namespace: of the drivers.
    """

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace
        self._before = self._look()

    def seen(self) -> tuple[ReaderSeen, ...]:
        found = []
        for key, record in self._look().items():
            before = self._before.get(key)
            if before is not None and record.kind == _EVERY_FRAME:
                frames, lost = record.frames - before.frames, record.lost - before.lost
                found.append(ReaderSeen(record.program, record.pid, record.service, max(0, frames), max(0, lost)))
        return tuple(found)

    def _look(self) -> dict[tuple[int, str], ReaderRecord]:
        return {(one.pid, one.service): one for one in living_readers(self._namespace)}


def waiting_drivers(known: set[int], proc: Path = _PROC) -> tuple[int, ...]:
    """Processes of ``skin-driver`` that publish nothing.

    Args:
        known: processes of drivers that do.
        proc: procfs.
    """
    found = {int(path.name) for path in proc.glob("[0-9]*") if program_of(int(path.name), proc) == _DRIVER}
    return tuple(sorted(found - known))


def publishes_again(pid: int, proc: Path = _PROC) -> bool:
    """Whether a process has no bus: what it publishes is another driver's, or was once.

    Args:
        pid: of a driver.
        proc: procfs.
    """
    return program_of(pid, proc) in _SECOND_HAND


def program_of(pid: int, proc: Path = _PROC) -> str:
    """Name of a process' program; empty if there is no such process."""
    try:
        return (proc / str(pid) / "comm").read_text(errors="replace").strip()
    except OSError:
        return ""
