"""CAN interfaces for tests are fixtures of the package."""

from __future__ import annotations

from skinware_drivers.testing.plugin import ip

__all__ = ["ip"]
