"""The options of the emulated ROBOSKIN boards."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.device import Count, EmulatorOptions, Probability, Seconds

_PLACES = ("BOARD", "BOARD/TRIANGLE", "BOARD/TRIANGLE/TAXEL")
_LIMITS = (("board", 1, 14), ("triangle", 0, 15), ("taxel", 0, 11))


class EmulatedRoboskinOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The boards, their touch and their faults.

    Raises:
        ConfigurationError: an option is out of its limits, or names a missing board.
    """

    boards: Annotated[tuple[int, ...], Meta(description="CAN addresses of the boards, 1-14")] = (7, 8, 9, 10)
    mtb3: Annotated[tuple[int, ...], Meta(description="boards of the older kind MTB3; the others are MTB4")] = ()
    stage: Annotated[str, Meta(description="TOML file of what presses the boards, instead of the wandering press")] = ""
    short_tail: Annotated[
        bool, Meta(description="old firmware: the second frame of a triangle has 6 bytes and no diagnostics")
    ] = False
    tail_class: Annotated[
        int,
        Meta(ge=0, le=7, description="message class of the second frame; 6 in the firmware variant for TLR"),
    ] = 4

    wrong_length: Annotated[Probability, Meta(description="probability that a data frame has a wrong length")] = 0.0
    dead_after_s: Annotated[Seconds, Meta(description="seconds from power-up to the death of the boards of dead")] = 0.0
    dead_after_cycles: Annotated[
        Count | None, Meta(description="bursts before their death, instead of dead_after_s")
    ] = None
    not_connected: Annotated[
        tuple[str, ...], Meta(description="triangles that were never plugged in, as BOARD/TRIANGLE")
    ] = ()
    unplugged: Annotated[tuple[str, ...], Meta(description="triangles that get unplugged, as BOARD/TRIANGLE")] = ()
    unplugged_after_cycles: Annotated[Count, Meta(description="bursts of the board before that")] = 20
    no_ack: Annotated[tuple[str, ...], Meta(description="triangles that stop acknowledging, as BOARD/TRIANGLE")] = ()
    no_ack_after_cycles: Annotated[Count, Meta(description="bursts of the board before that")] = 20
    out_of_range: Annotated[
        tuple[str, ...], Meta(description="broken taxels, far out of range, as BOARD/TRIANGLE/TAXEL")
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.boards:
            raise ConfigurationError("option boards: at least one board is needed")
        for address in self.boards:
            if not 1 <= address <= 14:
                raise ConfigurationError(
                    f"option boards: address {address} is outside 1-14 (0 is the host, 15 all boards)"
                )
        if len(set(self.boards)) < len(self.boards):
            raise ConfigurationError("option boards: an address is given twice")
        for name in ("mtb3", "dead", "restart"):
            self._check_boards(name, getattr(self, name))
        for name, depth in (("not_connected", 2), ("unplugged", 2), ("no_ack", 2), ("out_of_range", 3)):
            self._check_boards(name, [place[0] for place in self.places(name, depth)])

    def places(self, name: str, depth: int) -> list[tuple[int, ...]]:
        """Return the places of a list option as numbers.

        Args:
            depth: 2 for (board, triangle), 3 for (board, triangle, taxel).

        Raises:
            ConfigurationError: a text has another form, or a number is out of its limits.
        """
        found: list[tuple[int, ...]] = []
        for text in getattr(self, name):
            parts = text.split("/")
            if len(parts) != depth or not all(part.isascii() and part.isdigit() for part in parts):
                raise ConfigurationError(f"option {name}: {text!r} is not of the form {_PLACES[depth - 1]}")
            numbers = tuple(int(part) for part in parts)
            for (what, first, last), number in zip(_LIMITS, numbers, strict=False):
                if not first <= number <= last:
                    raise ConfigurationError(f"option {name}: {what} {number} in {text!r} is outside {first}-{last}")
            found.append(numbers)
        return found

    def _check_boards(self, name: str, addresses: Iterable[int]) -> None:
        for address in addresses:
            if address not in self.boards:
                raise ConfigurationError(
                    f"option {name}: there is no board {address}; boards={','.join(map(str, self.boards))}"
                )
