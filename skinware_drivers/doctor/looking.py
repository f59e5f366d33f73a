"""Gathers the evidence of what runs on this machine now."""

from __future__ import annotations

from collections.abc import Callable

from skinware.bridge_state import BridgeState
from skinware.errors import NamespaceError
from skinware.memory.namespace import Namespace
from skinware.views.bridges import LiveBridges
from skinware_drivers.doctor import programs, surroundings
from skinware_drivers.doctor.evidence import DriverSeen, Evidence
from skinware_drivers.doctor.watching import watch
from skinware_drivers.finding import interfaces, ports, running


def look(namespace: Namespace, seconds: float, tell: Callable[[float], object] = lambda _seconds: None) -> Evidence:
    """Look at everything that runs or is plugged in.

    Args:
        namespace: whose drivers are looked at.
        seconds: how long.
        tell: called now and then with how long that is by now, s.
    """
    machine, readers = surroundings.MachineWatch(), programs.ReadersWatch(namespace)
    before = interfaces.can_interfaces()
    namespaces = surroundings.namespaces_seen(namespace)
    drivers: tuple[DriverSeen, ...]
    try:
        drivers = watch(namespace, seconds, tell)
    except NamespaceError:  # told as a namespace that cannot be looked at
        drivers = ()
    living = running.running_drivers()
    return Evidence(
        seconds=seconds,
        namespace=namespace.name,
        drivers=drivers,
        machine=machine.seen(),
        namespaces=namespaces,
        interfaces=surroundings.interfaces_seen(before, interfaces.can_interfaces()),
        kernel_has_can=interfaces.kernel_has_can(),
        ports=tuple(ports.serial_ports()),
        running=tuple(one for one in living if not programs.publishes_again(one.pid)),
        waiting=programs.waiting_drivers({one.pid for one in living}),
        readers=readers.seen(),
        bridges=_bridges(namespace),
    )


def _bridges(namespace: Namespace) -> tuple[BridgeState, ...]:
    live = LiveBridges(namespace)
    try:
        live.look(namespace.services())
        return tuple(live.states())
    except NamespaceError:
        return ()
    finally:
        live.close()
