"""Named services: a writer that owns a name, readers that find it, lose it and find it again."""

from skinware.service._reader import Position, ServiceReader
from skinware.service._writer import DEFAULT_SLOTS, ServiceWriter

__all__ = ["DEFAULT_SLOTS", "Position", "ServiceReader", "ServiceWriter"]
