"""Makes a file whole that was cut off or damaged: all that is undamaged, in a new file with a summary."""

from __future__ import annotations

import contextlib
import errno
import os
from dataclasses import dataclass
from pathlib import Path

from skinware.errors import BadRecording
from skinware.recording.mcap_reading import ChunkContents, Damaged, McapSource
from skinware.recording.mcap_writing import McapFile, OpenChunk


@dataclass(frozen=True)
class Recovered:
    """What came of a recovery.

    Attributes:
        messages: of each channel that are in the new file.
        damaged: chunks that were found, but are damaged.
        was_whole: the file ended in good order, and nothing of it was damaged.
    """

    messages: dict[str, int]
    damaged: int
    was_whole: bool


def recover(source: Path, target: Path) -> Recovered:
    """Write what is undamaged in a recording into a new file, which is there only when it is complete.

    Args:
        source: the recording; it is only read.
        target: the new file; may have the place of the old one, and of no other.

    Raises:
        BadRecording: it is not a recording, or nothing of it can be used.
        OSError: it cannot be read, or the new one cannot be written.
    """
    if target.exists() and not target.samefile(source):
        raise FileExistsError(errno.EEXIST, "exists already: give another name", str(target))
    with McapSource(source) as old:
        begun = target.with_name(f".{target.name}.{os.getpid()}.part")
        new = McapFile(begun)
        damaged = old.damaged
        try:
            for place in old.chunks:
                try:
                    contents = old.contents(place)
                except Damaged:
                    damaged += 1
                    continue
                chunk = _again(contents)
                if not chunk.is_empty:
                    new.add(chunk.close())
            new.finish()
            if not new.counts:
                raise BadRecording(f"{source}: nothing in it can be used: no chunk is undamaged")
            os.rename(begun, target)
        except BaseException:
            with contextlib.suppress(OSError):
                new.finish()
            begun.unlink()
            raise
        messages = {old.channels[channel].topic: count for channel, count in sorted(new.counts.items())}
        return Recovered(messages, damaged, old.is_whole and not damaged)


def _again(contents: ChunkContents) -> OpenChunk:
    chunk = OpenChunk()
    for message in contents.messages:
        channel = contents.channels.get(message.channel_id)
        schema = contents.schemas.get(channel.schema_id) if channel is not None else None
        if channel is not None and schema is not None:
            chunk.add(channel, schema, message.sequence, message.time_ns, message.data)
    return chunk
