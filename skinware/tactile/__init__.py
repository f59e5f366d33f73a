"""Understand touch: what touches the skin, where and how hard, whatever drifts. numpy only.

Everything works on arrays, in a notebook or on a recording::

    from skinware.tactile import Baseline, Contacts

    baseline, contacts = Baseline.of(structure, "pressure"), Contacts.of(structure, "pressure")
    for frame in frames:
        calm = baseline.take(frame)
        for contact in contacts.update(calm.value, calm.touched, frame.acquired_ns):
            print(contact.id, contact.load, contact.cop_m, contact.taxels)

``skin-calm`` does the same for other programs, and :class:`ContactsReader` reads what it publishes. The modules of this
package have more: stages, tables of neighbours, calibration, worlds to test in.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skinware.tactile.baseline import Baseline, BaselineSettings, Calm
    from skinware.tactile.chain import ChainSettings
    from skinware.tactile.contacts import Contact, Contacts, ContactSet
    from skinware.tactile.contacts_service import ContactsReader
    from skinware.tactile.health import Health, HealthKind, HealthReport, HealthSettings
    from skinware.tactile.health_service import HealthReader
    from skinware.tactile.motion import MotionReader, MotionSet, motion_of
    from skinware.tactile.onsets import ContactEvent, EventKind
    from skinware.tactile.regions import Box, Region, Regions, put_region, read_regions
    from skinware.tactile.tracking import ContactKind, TrackingSettings

__all__ = [
    "Baseline",
    "BaselineSettings",
    "Box",
    "Calm",
    "ChainSettings",
    "Contact",
    "ContactEvent",
    "ContactKind",
    "ContactSet",
    "Contacts",
    "ContactsReader",
    "EventKind",
    "Health",
    "HealthKind",
    "HealthReader",
    "HealthReport",
    "HealthSettings",
    "MotionReader",
    "MotionSet",
    "Region",
    "Regions",
    "TrackingSettings",
    "motion_of",
    "put_region",
    "read_regions",
]

_MODULES = (
    "baseline",
    "contacts",
    "tracking",
    "regions",
    "chain",
    "health",
    "motion",
    "contacts_service",
    "health_service",
    "onsets",
)
"""The modules that have these names, those that import little first."""


def __getattr__(name: str) -> Any:
    """Import a name when it is first used: commands, which import modules of this package, start fast."""
    if name in __all__:
        for module in map(importlib.import_module, (f"{__name__}.{module}" for module in _MODULES)):
            if name in vars(module):
                return vars(module)[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, imported or not, for completion."""
    return sorted({*globals(), *__all__})
