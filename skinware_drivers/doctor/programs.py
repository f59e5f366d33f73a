"""Programs of this machine: those that read drivers, and drivers that have found nothing yet."""

from __future__ import annotations

from pathlib import Path

from skinware.memory.announcement import ReaderRecord, living_readers
from skinware.memory.namespace import Namespace
from skinware_drivers.doctor.evidence import ReaderSeen

_EVERY_FRAME = "in order"
"""How readers read that want every frame; others are meant to skip some."""
_DRIVER = "skin-driver"


class ReadersWatch:
    """Looks at the programs that read the drivers of a namespace: now, and at the end of the watch.

    Args:
        namespace: of the drivers.
    """

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace
        self._before = self._look()

    def seen(self) -> tuple[ReaderSeen, ...]:
        """Those that were there all the time, and want every frame."""
        found = []
        for key, record in self._look().items():
            before = self._before.get(key)
            if before is not None and record.kind == _EVERY_FRAME:
                frames, lost = record.frames - before.frames, record.lost - before.lost
                found.append(ReaderSeen(record.program, record.pid, record.service, max(0, frames), max(0, lost)))
        return tuple(found)

    def _look(self) -> dict[tuple[int, str], ReaderRecord]:
        return {(one.pid, one.service): one for one in living_readers(self._namespace)}


def waiting_drivers(known: set[int], proc: Path = Path("/proc")) -> tuple[int, ...]:
    """Processes of ``skin-driver`` that publish nothing.

    Args:
        known: processes of drivers that do.
        proc: procfs.
    """
    found = set()
    for path in proc.glob("[0-9]*/comm"):
        try:
            if path.read_text(errors="replace").strip() == _DRIVER:
                found.add(int(path.parent.name))
        except OSError:  # it ended meanwhile
            continue
    return tuple(sorted(found - known))


__all__ = ["ReadersWatch", "waiting_drivers"]
