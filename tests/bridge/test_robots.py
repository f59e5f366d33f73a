"""Several robots over one network: none is ever taken for another."""

from __future__ import annotations

import shutil
from contextlib import ExitStack

import pytest

from skinware import DriverReader, DriverWriter
from skinware.memory.namespace import Namespace
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.rig import joining, network, publish, serving, structure


def driver(namespace: Namespace) -> DriverWriter:
    return DriverWriter("arm", structure(), namespace=namespace, rate_hz=50)


@pytest.mark.parametrize("mode", ["push", "pull"])
def test_two_robots_of_one_name_are_told_and_never_mixed(namespace: Namespace, mode: str) -> None:
    with ExitStack() as stack:
        net = stack.enter_context(network())
        ends = stack.enter_context(joining(net, namespace, mode))
        seen: list[int] = []

        def sees(value: int) -> bool:
            for writer, own in ((first, 1), (second, 2)):
                publish(writer, own)
            try:
                with DriverReader("arm", namespace=ends.here) as reader:
                    seen.append(int(reader.read().values[0]) if reader.alive else 0)
            except Exception:  # noqa: BLE001, not there yet
                return False
            return seen[-1] == value

        other = Namespace(f"{namespace.name}-other")
        stack.callback(shutil.rmtree, other.path, ignore_errors=True)
        first, second = stack.enter_context(driver(namespace)), stack.enter_context(driver(other))
        with ExitStack() as one:
            one.enter_context(serving(net, namespace))
            wait_until(lambda: sees(1))
            stack.enter_context(serving(net, other))
            wait_until(lambda: any("served by two bridges" in event.get("why", "") for event in ends.events))
            for _ in range(50):
                sees(1)
            assert set(seen) <= {0, 1}
        wait_until(lambda: sees(2))
        values = [value for value in seen if value]
        assert values == sorted(values), "the first came back after the other"
