"""Named services: a writer that owns a name, readers that find it, lose it and find it again; requests and answers."""

from skinware.memory.schema import Column, Schema
from skinware.service._client import PendingRequest
from skinware.service._ownership import Columns
from skinware.service._reader import ServiceReader
from skinware.service._server import Request, RequestServer
from skinware.service._taking import Position
from skinware.service._writer import ServiceWriter, Writer

__all__ = [
    "Column",
    "Columns",
    "PendingRequest",
    "Position",
    "Request",
    "RequestServer",
    "Schema",
    "ServiceReader",
    "ServiceWriter",
    "Writer",
]
