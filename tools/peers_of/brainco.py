"""What exchanges with BrainCo's programs have in common: hands with given values, and lines of a comparison."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

from skinware_drivers.testing.driving import emulated_on_a_pty


class Comparison:
    """Comparisons with one program of the maker.

    Args:
        program: name of its package.

    Attributes:
        differs: whether anything did.
    """

    def __init__(self, program: str) -> None:
        print(f"program: {program} {version(program)}", flush=True)
        self.differs = False

    def agree(self, what: str, ours: object, theirs: object) -> None:
        """Compare what the hand has with what the program says."""
        self.differs |= ours != theirs
        print(f"agreed: {what}" if ours == theirs else f"differs: {what}: ours {ours!r}, theirs {theirs!r}", flush=True)


@contextmanager
def at_a_port(emulator: Any, felt: list[int], **options: Any) -> Iterator[str]:
    """An emulated hand whose sensors have these values; yields the path of its port."""

    class Steady(emulator):  # type: ignore[misc]
        def __init__(self, given: Any, **more: Any) -> None:
            super().__init__(given, **{**more, "source": lambda _number, _cycle: felt})

    with emulated_on_a_pty(Steady, **options) as port:
        yield port
