"""The files that are left of a walk."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import msgspec

from skinware.errors import ConfigurationError
from skinware_drivers.proving.proof import Proof


class ProofFiles:
    """Report, the same as JSON, and the capture.

    Args:
        stem: what their names have in common.

    Attributes:
        report, data, capture: their paths; the capture is written by others.
        captured: what came of the capture; empty as long as it is not known.
    """

    def __init__(self, stem: Path) -> None:
        self.report, self.data, self.capture = self._all = [
            stem.with_name(f"{stem.name}.{ending}") for ending in ("md", "json", "mcap")
        ]
        self.captured: dict[str, Any] = {}

    @property
    def written(self) -> list[str]:
        return [str(path) for path in self._all if path.exists()]

    def refuse_old(self) -> None:
        """Before somebody walks for ten minutes.

        Raises:
            ConfigurationError: there is no such folder, or a file is there already.
        """
        if not self.capture.parent.is_dir():
            raise ConfigurationError(f"-o {self.capture.with_suffix('')}: there is no folder {self.capture.parent}")
        if self.written:
            raise ConfigurationError(f"{self.written[0]}: exists already: give another name (-o), or remove it")

    def capture_text(self, *, is_whole: bool) -> str:
        beginning = "from the first byte on" if is_whole else "without what was said before skin-prove began"
        text = f"{self.capture.name}, {beginning}"
        if self.captured.get("lost"):
            text += f"; {self.captured['lost']} frames lost"
        return text + (f"; ended early: {self.captured['problem']}" if self.captured.get("problem") else "")

    def write(self, proof: Proof) -> OSError | None:
        """Write the report and the same as JSON; what went wrong is no reason not to show the proof."""
        data = msgspec.json.format(msgspec.json.encode(proof.as_data()))
        wrong = None
        for path, content in ((self.report, proof.as_markdown().encode()), (self.data, data + b"\n")):
            try:
                path.write_bytes(content)
            except OSError as error:
                with contextlib.suppress(OSError):
                    path.unlink()  # half of it
                wrong = wrong or OSError(error.errno, error.strerror, str(path))
        return wrong
