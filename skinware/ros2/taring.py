"""Taring drivers from a ROS 2 graph: a service of the type ``std_srvs/Trigger`` for each."""

from __future__ import annotations

import time
from collections.abc import Callable

from skinware.conversion.ros_messages import Cdr
from skinware.errors import RequestTimeout
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.ros2 import types
from skinware.ros2.transport import Node
from skinware.service import PendingRequest, ServiceReader

OPERATION = "tare"
_PATIENCE_S = 10.0
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.0002, 0.02


class Taring:
    """What answers requests.

    Args:
        node: of the graph.
        namespace: of the drivers.
    """

    def __init__(self, node: Node, namespace: Namespace) -> None:
        self._node, self._namespace = node, namespace
        self._stopping = False

    def offer(self, service: str, driver: str) -> Callable[[], None]:
        """Have a service for a driver; what ends it.

        A driver that cannot be tared answers so.
        """
        return self._node.service(service, types.TRIGGER, lambda _: self._tare(driver))

    def stop(self) -> None:
        self._stopping = True

    def _tare(self, driver: str) -> bytes:
        try:
            with ServiceReader(driver, namespace=self._namespace, announce=False) as reader:
                self._wait_for(reader.ask(OPERATION))
        except Exception as error:  # noqa: BLE001, whoever asked is told
            return response(False, str(error))
        return response(True, "")

    def _wait_for(self, pending: PendingRequest) -> None:
        until_ns, pause_s = now_ns() + round(_PATIENCE_S * NS_PER_S), _SHORTEST_PAUSE_S
        while not pending.done():
            if self._stopping or now_ns() > until_ns:
                pending.cancel()
                raise RequestTimeout(f"no answer within {_PATIENCE_S:g} s; it may have been carried out")
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        pending.result(0.0)


def response(success: bool, message: str) -> bytes:
    return Cdr().numbers("?", success).text(message).done()
