"""The bridges over which the services of a namespace come, looked at live."""

from __future__ import annotations

from skinware.bridge_state import BridgeReader, BridgeSample, BridgeState
from skinware.memory.namespace import Namespace
from skinware.views.live_services import LiveServices


class LiveBridges(LiveServices[BridgeReader, BridgeSample]):
    """What the bridges of a namespace tell of themselves.

    Args:
        namespace: where to look.
    """

    def __init__(self, namespace: Namespace) -> None:
        super().__init__(namespace, BridgeReader)

    def states(self) -> list[BridgeState]:
        frames = [self._newest(name) for name in list(self._readers)]
        return [frame.state for frame in frames if frame is not None]
