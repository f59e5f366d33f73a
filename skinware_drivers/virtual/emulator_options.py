"""The options that every emulator has."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from skinware_drivers.options import Options

Probability = Annotated[float, Meta(ge=0, le=1)]
Seconds = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=0)]


class EmulatorOptions(Options, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Touch and faults; an emulator adds options for its devices.

    Raises:
        ConfigurationError: an option is out of its limits.
    """

    pattern: Annotated[
        Literal["touch", "idle", "cycle"],
        Meta(description="input: a wandering press, nothing, or each burst's number in every value"),
    ] = "touch"
    seed: Annotated[Count, Meta(description="seed of the touch and of the random faults")] = 0
    streaming: Annotated[bool, Meta(description="send from power-up, as if a host had started the devices")] = False

    lose: Annotated[Probability, Meta(description="probability that a data frame is lost")] = 0.0
    repeat: Annotated[Probability, Meta(description="probability that a data frame is sent twice")] = 0.0
    truncate: Annotated[Probability, Meta(description="probability that a data frame is cut short")] = 0.0
    corrupt: Annotated[Probability, Meta(description="probability that a data frame contains random bytes")] = 0.0
    jitter_us: Annotated[Count, Meta(description="longest random delay of a burst, in microseconds")] = 0
    foreign_hz: Annotated[
        float, Meta(ge=0, le=10_000, description="frames per second from other devices on the bus")
    ] = 0.0
    silence: Annotated[
        tuple[str, ...], Meta(description="kinds of frames that the devices stop sending, after silence_after_s")
    ] = ()
    silence_after_s: Annotated[Seconds, Meta(description="seconds from power-up to that silence")] = 2.0
    dead: Annotated[tuple[int, ...], Meta(description="devices that die, after dead_after_s")] = ()
    dead_after_s: Annotated[Seconds, Meta(description="seconds from power-up to their death")] = 2.0
    restart: Annotated[
        tuple[int, ...], Meta(description="devices that lose power for a moment, after restart_after_s")
    ] = ()
    restart_after_s: Annotated[Seconds, Meta(description="seconds from power-up to the restart")] = 2.0
    boot_s: Annotated[Seconds, Meta(description="seconds for which a restarted device ignores commands")] = 0.5
