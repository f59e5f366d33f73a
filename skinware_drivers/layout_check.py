"""Check that a layout fits the patches and the period of its driver."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skinware.errors import ConfigurationError
from skinware_drivers.decoding.addresses import Addresses
from skinware_drivers.description import Patch, SkinTables
from skinware_drivers.fields import Packed
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from skinware_drivers.native.compiling import check_values

_DTYPES = ("u1", "i2", "u2", "i4", "f4")
"""Dtypes that a driver can have, the smallest first."""


def check_layout(layout: Layout, patches: Sequence[Patch], tables: SkinTables, period_s: float) -> None:
    """Refuse a layout under which values would be cut or dropped, or halves of two cycles be joined.

    Args:
        period_s: nominal time between two updates of a module.

    Raises:
        ConfigurationError: it does not fit; the message says how to change it.
    """
    for cycle in layout.cycles:
        _check_age(cycle, cycle.period_s or period_s)
        writer: dict[int, str] = {}
        for frame in [frame for frame in layout.frames if frame.name in cycle.members]:
            for channel in {c for values in frame.runs for c in values.channels if c is not None}:
                other = writer.setdefault(channel, frame.name)
                if other != frame.name:
                    raise ConfigurationError(
                        f"frames {other!r} and {frame.name!r} of a cycle both have a value for channel {channel}: a"
                        " value lies in one frame, give each frame channels of its own (`to`)"
                    )
    n_channels = [len(module.channels) for patch in patches for module in patch.modules]
    names = [patch.name for patch in patches for _ in patch.modules]
    addresses = Addresses(layout.frames, [range(len(layout.frames))], tables)
    for number, frame in enumerate(layout.frames):
        check_values(frame)
        for values in frame.runs:
            _check_dtype(frame, values, tables.structure.dtype)
        needed = 1 + max((c for values in frame.runs for c in values.channels if c is not None), default=-1)
        for module in addresses.modules_of(number, frame):
            if needed > n_channels[module]:
                raise ConfigurationError(
                    f"frame {frame.name!r} has a value for channel {needed - 1}, and a module of {names[module]!r} has"
                    f" {n_channels[module]} channels, from 0: give it more, or say with `to` which values are dropped"
                    " (None)"
                )


def _check_age(cycle: Cycle, period_s: float) -> None:
    if cycle.reach_s < cycle.turn * period_s:
        return
    fits = f"`period_s` is {period_s:g} s" + (f", its counter has {cycle.turn} values" if cycle.turn > 1 else "")
    most = "half of that" if cycle.order == "any" else "that"
    raise ConfigurationError(
        f"cycle of {', '.join(cycle.members)}: two cycles fit into maximum_age_s = {cycle.maximum_age_s:g}, and their"
        f" frames could not be distinguished ({fits}): make it shorter than {most}, say half as long"
        + ("" if cycle.turn > 1 else "; or say where its frames have a `counter`")
    )


def _check_dtype(frame: Frame, values: Values, dtype: np.dtype[np.generic]) -> None:
    if all(channel is None for channel in values.channels) or _holds(dtype, values.dtype):
        return
    sent = f"{values.dtype.bits} bits" if isinstance(values.dtype, Packed) else f"dtype {values.dtype!r}"
    wide = next((name for name in _DTYPES if _holds(np.dtype(name), values.dtype)), None)
    hint = f"; give it `dtype` = {np.dtype(wide).name}" if wide else ""
    raise ConfigurationError(f"frame {frame.name!r}: values of {sent} do not fit the driver's dtype {dtype.name}{hint}")


def _holds(dtype: np.dtype[np.generic], sent: str | Packed) -> bool:
    """Return whether the dtype has every value that can be sent (float32: at least nearly)."""
    if not isinstance(sent, Packed) and np.dtype(sent).kind not in "iu":
        return np.can_cast(sent, dtype, "safe")
    if dtype.kind == "f":
        return True
    if isinstance(sent, Packed):
        bits = sent.bits - sent.signed
        least, most = -(1 << bits) if sent.signed else 0, (1 << bits) - 1
    else:
        least, most = int(np.iinfo(np.dtype(sent).name).min), int(np.iinfo(np.dtype(sent).name).max)
    limits = np.iinfo(dtype.name)
    return bool(limits.min <= least and most <= limits.max)
