"""The skin understood: what touches it, where and how hard, whatever drifts. numpy only.

Everything works on arrays, in a notebook or on a recording::

    from skinware.tactile import Baseline, Contacts

    baseline, contacts = Baseline.of(structure, "pressure"), Contacts.of(structure, "pressure")
    for frame in frames:
        calm = baseline.take(frame)
        for contact in contacts.update(calm.value, calm.touched, frame.acquired_ns):
            print(contact.id, contact.load, contact.cop_m, contact.taxels)

Services do the same for other programs (``skin-calm``), and :class:`ContactsReader` reads what they found.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skinware.tactile.baseline import Baseline
    from skinware.tactile.calm import BaselineSettings, Calm
    from skinware.tactile.chain import BaselineStageSettings, Chain, ChainSettings, CurveSettings
    from skinware.tactile.contacts import Contact, Contacts, ContactSet
    from skinware.tactile.contacts_service import ContactsReader, ContactsSample
    from skinware.tactile.curves import Curve, CurveTable, fit_curve, read_curves
    from skinware.tactile.health import Health, HealthSettings
    from skinware.tactile.health_report import HealthKind, HealthReport
    from skinware.tactile.health_service import HealthReader
    from skinware.tactile.motion import MotionSet, RegionMotion, motion_of
    from skinware.tactile.motion_service import MotionReader
    from skinware.tactile.neighbours import neighbours_of_pairs
    from skinware.tactile.regions import Box, Region, Regions, put_region, read_regions
    from skinware.tactile.stages import AmplifierSettings, FilterSettings, ScalerSettings, Signal, Taxels
    from skinware.tactile.tracking import ContactKind, TrackingSettings

__all__ = [
    "AmplifierSettings",
    "Baseline",
    "BaselineSettings",
    "BaselineStageSettings",
    "Box",
    "Calm",
    "Chain",
    "ChainSettings",
    "Contact",
    "ContactKind",
    "ContactSet",
    "Contacts",
    "ContactsReader",
    "ContactsSample",
    "Curve",
    "CurveSettings",
    "CurveTable",
    "FilterSettings",
    "Health",
    "HealthKind",
    "HealthReader",
    "HealthReport",
    "HealthSettings",
    "MotionReader",
    "MotionSet",
    "Region",
    "RegionMotion",
    "Regions",
    "ScalerSettings",
    "Signal",
    "Taxels",
    "TrackingSettings",
    "fit_curve",
    "motion_of",
    "neighbours_of_pairs",
    "put_region",
    "read_curves",
    "read_regions",
]

_MODULES = (
    "calm",
    "baseline",
    "contacts",
    "tracking",
    "neighbours",
    "regions",
    "stages",
    "curves",
    "chain",
    "health_report",
    "health",
    "motion",
    "contacts_service",
    "health_service",
    "motion_service",
)
"""Where the names are, what imports little first."""


def __getattr__(name: str) -> Any:
    """Import what is asked for, and no more: commands and the world to test in, which are here too, start fast."""
    if name in __all__:
        for module in map(importlib.import_module, (f"{__name__}.{module}" for module in _MODULES)):
            if name in vars(module):
                return vars(module)[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, too, although most are not imported yet: for completion."""
    return sorted({*globals(), *__all__})
