"""What is probably wrong with a layout, judged by the frames that it did not take: for the author of a driver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from skinware.samples import Unused, sample_report, sample_text
from skinware_drivers.bus import EXTENDED_FLAG, Bus, identifier_text
from skinware_drivers.conditions import Byte
from skinware_drivers.layout import Frame, Layout

Sample = Mapping[str, Any]
"""As :func:`skinware.samples.sample_report` tells it."""


def why_unused(layout: Layout, bus: Bus) -> list[str]:
    """Reasons, in a few words each; none if nothing is known.

    Args:
        layout: of this bus.
        bus: with samples of the frames that were not taken.
    """
    samples = sample_report(bus.samples.rows)
    reasons = _lengths(layout, samples)
    if bus.medium == "can":
        reasons += list(_kinds_of_identifier(layout, samples))[:1]
    if wrong := bus.counters.framing.checksum_errors:
        reasons.append(
            f"{wrong} checksums were wrong: look at the kind of `checksum`, at its byte order and at what it `covers`"
        )
    return reasons


def _lengths(layout: Layout, samples: Sequence[Sample]) -> list[str]:
    reasons: dict[tuple[str, int], str] = {}
    for sample in samples:
        if sample["why"] != Unused.BAD_LENGTH.name.lower():
            continue
        came = f"{sample['length']} byte{'' if sample['length'] == 1 else 's'} came ({sample_text(dict(sample))})"
        for frame in layout.frames:
            if _is_of(frame, sample):
                known = " or ".join(map(str, sorted(frame.length)))
                reasons.setdefault(
                    (frame.name, sample["length"]), f"frames {frame.name!r} have length {known}, but {came}"
                )
    return list(reasons.values())


def _is_of(frame: Frame, sample: Sample) -> bool:
    """Whether a frame of this kind can be what a sample is of, but for its length."""
    identifier, data = _identifier(sample), bytes.fromhex(sample["data"])
    for condition in frame.when:
        if isinstance(condition, Byte):
            if condition.offset < len(data) and data[condition.offset] & condition.mask != condition.value:
                return False
        elif condition.extended != sample["extended"] or identifier & condition.mask != condition.value:
            return False
    return bool(frame.when) or not sample["extended"]


def _kinds_of_identifier(layout: Layout, samples: Sequence[Sample]) -> Iterator[str]:
    """Identifiers of 29 bits where all that the layout has are of 11, or the other way round."""
    kinds = {frame.extended for frame in layout.frames}
    for sample in samples:
        if sample["why"] != Unused.UNKNOWN.name.lower() or len(kinds) > 1 or sample["extended"] in kinds:
            continue
        identifier = identifier_text(_identifier(sample))
        if sample["extended"]:
            yield (
                f"heard 0x{identifier} (29 bits) where the layout has only identifiers of 11 bits: write"
                f" EXTENDED_FLAG | 0x{identifier}"
            )
        else:
            yield (
                f"heard 0x{identifier} (11 bits) where the layout has only identifiers of 29 bits: write"
                f" 0x{identifier}, without EXTENDED_FLAG"
            )


def _identifier(sample: Sample) -> int:
    return int(sample["identifier"]) | (EXTENDED_FLAG if sample["extended"] else 0)
