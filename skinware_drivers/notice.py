"""What devices say of themselves beside their data."""

from __future__ import annotations

import enum


class Notice(enum.Enum):
    """What a device reports about itself, besides its data."""

    RESTARTED = "restarted"
    """It lost its configuration: ``revive`` is called for it, and for it alone."""
    CHANGED = "changed"
    """It is not what it was described as (another device was plugged in, new firmware): ``join`` is called."""
    LOST = "lost"
    """It is not there, or not in a state to send: stale, until data comes."""
    SUSPECT = "suspect"
    """It reports an error: all its values are suspect, until it is sound or was set up anew."""
    SOUND = "sound"
    """The error is over."""
