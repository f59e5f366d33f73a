"""``skin-find``: what is on the buses and ports of this machine."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from skinware_drivers.finding.interfaces import CanInterface
    from skinware_drivers.finding.looking import HeardOnBus, ProbeAnswer
    from skinware_drivers.finding.ports import SerialPort
    from skinware_drivers.finding.running import RunningDriver

_DETECTION_S = 10.0


@cli.command(
    "skin-find",
    "skin-find                     CAN interfaces, adapters, serial ports",
    "skin-find can0 --probe        ask which devices are on can0",
    "skin-find dds://0             topics of DDS, and which driver reads them",
    "skin-find --udev              fixed names for the serial ports",
    "skin-find --json | jq '.can.interfaces[] | {name, up, bit_rate}'",
)
@click.argument("buses", nargs=-1, metavar="[BUS]...")
@click.option("--listen", "listen_s", type=cli.seconds, default="1", show_default=True, help="Listen for SECONDS.")
@click.option("--probe", is_flag=True, help="Send harmless requests to see which devices answer.")
@click.option(
    "--driver",
    "driver_names",
    multiple=True,
    metavar="DRIVER",
    help="Use only this driver (name or file) to recognize and probe devices.",
)
@click.option("--force", is_flag=True, help="With --probe: also where requests may disturb devices or programs.")
@click.option("--udev", is_flag=True, help="Print udev rules for the serial devices that are plugged in.")
@cli.json_option
def command(
    buses: tuple[str, ...],
    listen_s: float,
    probe: bool,
    driver_names: tuple[str, ...],
    force: bool,
    udev: bool,
    as_json: bool,
) -> None:
    """Show what is plugged in, its traffic, and which driver could use it. Sends nothing without --probe.

    With BUS, such as can0 or /dev/ttyUSB0: only that. --probe sends no discovery where boards are sending, because this
    would silence some of them; --force does.

    Exit status: 0 done, 1 failed, or a BUS is not available, 2 wrong usage.
    """
    if force and not probe:
        raise click.UsageError("--force needs --probe")
    if udev:
        _print_rules(buses, as_json)
        return
    found = asyncio.run(look(buses, listen_s, probe=probe, force=force, driver_names=driver_names))
    if as_json:
        print_json(found)
    else:
        from skinware_drivers.cli.find_text import as_text

        echo("\n".join(as_text(found)))


async def look(
    buses: tuple[str, ...],
    listen_s: float,
    *,
    probe: bool = False,
    force: bool = False,
    driver_names: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Return everything that ``skin-find`` prints, as data for JSON.

    Raises:
        BusNotAvailable: one of ``buses`` does not exist.
        ConfigurationError: one of ``driver_names`` does not exist, or one of ``buses`` is not the name of a bus.
    """
    from skinware.errors import BusNotAvailable
    from skinware_drivers.bus_names import BusName
    from skinware_drivers.finding.guess import known_drivers
    from skinware_drivers.finding.interfaces import Detection, can_interfaces, detect_adapters
    from skinware_drivers.finding.looking import listen, topics_on
    from skinware_drivers.finding.running import running_drivers
    from skinware_drivers.registry import make_bus

    drivers = known_drivers("can", driver_names)
    running = running_drivers()
    interfaces, ports, others = _chosen(buses, can_interfaces())
    networks = [name for name in others if BusName.of(name).is_only_asked]
    for name in networks:
        make_bus(name)  # refuses bad names, also without --probe
    buses_to_hear = [one.name for one in interfaces if one.up]
    buses_to_hear += [name for name in others if not BusName.of(name).is_only_asked]

    async def search() -> Any:
        return Detection() if buses else await asyncio.to_thread(detect_adapters, _DETECTION_S)

    topics = {
        name: await asyncio.to_thread(topics_on, name, listen_s, known_drivers("serial", driver_names))
        for name in networks
        if BusName.of(name).interface == "dds"
    }
    detection: Detection
    detection, *listened = await asyncio.gather(search(), *(listen(name, listen_s, drivers) for name in buses_to_hear))
    heard: dict[str, HeardOnBus] = {one.bus: one for one in listened}
    problems = [one.problem for one in listened if one.problem]
    if buses and problems:
        raise BusNotAvailable(problems[0])
    answers = await _ask(heard, ports, networks, running, force, driver_names) if probe else {}
    return {
        "can": _can_data(interfaces, heard, answers, running, whole=not buses),
        "buses": [
            _heard_data(name, heard, answers, running) | ({"topics": topics[name]} if name in topics else {})
            for name in others
        ],
        "adapters": detection.found,
        "adapters_problem": detection.problem,
        "ports": [_port_data(port, answers, running) for port in ports],
    }


def _chosen(
    buses: tuple[str, ...], interfaces: list[CanInterface]
) -> tuple[list[CanInterface], list[SerialPort], list[str]]:
    """Return CAN interfaces, serial ports, and names of other buses; all of the machine if none is named."""
    from skinware.errors import BusNotAvailable
    from skinware_drivers.bus_names import parse_bus_name
    from skinware_drivers.finding.ports import pseudo_terminal, serial_ports
    from skinware_drivers.finding.running import same_bus

    if not buses:
        return interfaces, serial_ports(), []
    chosen: tuple[list[CanInterface], list[SerialPort], list[str]] = [], [], []
    for name in buses:
        interface, channel, _ = parse_bus_name(name)
        if interface in ("serial", "pty"):
            port = next((port for port in serial_ports() if same_bus(port.path, channel or name)), None)
            port = port or pseudo_terminal(channel)
            if port is None:
                raise BusNotAvailable(f"there is no serial port {name}; skin-find lists all")
            chosen[1].append(port)
        elif interface == "socketcan" and channel in [one.name for one in interfaces]:
            chosen[0].extend(one for one in interfaces if one.name == channel)
        else:
            chosen[2].append(name)
    return chosen


async def _ask(
    heard: dict[str, HeardOnBus],
    ports: list[SerialPort],
    networks: list[str],
    running: list[RunningDriver],
    force: bool,
    driver_names: tuple[str, ...],
) -> dict[str, ProbeAnswer]:
    from skinware_drivers.bus_names import parse_bus_name
    from skinware_drivers.finding.guess import known_drivers
    from skinware_drivers.finding.looking import ProbeAnswer, ask, ask_port
    from skinware_drivers.finding.running import driver_on

    answers = {}
    for name, one in heard.items():
        owner = driver_on(name, running)
        answers[name] = await ask(
            one, known_drivers("can", driver_names), force=force, owner="" if owner is None else str(owner)
        )
    for name in networks:
        owner = driver_on(name, running)
        refused = ProbeAnswer(name, refused=f"{owner} has it")
        medium = "modbus" if parse_bus_name(name).interface == "modbus" else "serial"
        answers[name] = refused if owner else await ask_port(name, known_drivers(medium, driver_names))
    for port in ports:
        owner = driver_on(port.path, running)
        users = [f"{user.program} (pid {user.pid})" for user in port.users]
        if owner is not None or users:
            answers[port.path] = ProbeAnswer(port.path, refused=f"{owner or ', '.join(users)} has it")
        elif not port.may_open:
            answers[port.path] = ProbeAnswer(port.path, refused="you may not open it")
        else:
            of_ports = known_drivers("serial", driver_names) | known_drivers("modbus", driver_names)
            answers[port.path] = await ask_port(port.path, of_ports)
    return answers


def _can_data(
    interfaces: list[CanInterface],
    heard: dict[str, HeardOnBus],
    answers: dict[str, ProbeAnswer],
    running: list[RunningDriver],
    *,
    whole: bool,
) -> dict[str, Any]:
    import msgspec

    from skinware_drivers.can.controller import NO_CAN
    from skinware_drivers.finding.interfaces import NO_INTERFACE, kernel_has_can

    in_kernel = kernel_has_can()
    advice = []
    if whole and not interfaces:
        advice.append(NO_INTERFACE if in_kernel else NO_CAN)
    return {
        "in_kernel": in_kernel,
        "advice": advice,
        "interfaces": [
            {
                **msgspec.to_builtins(one),
                "advice": one.advice(),
                **_heard_data(one.name, heard, answers, running),
            }
            for one in interfaces
        ],
    }


def _heard_data(
    name: str, heard: dict[str, HeardOnBus], answers: dict[str, ProbeAnswer], running: list[RunningDriver]
) -> dict[str, Any]:
    from skinware_drivers.finding.running import driver_on

    return {"bus": name, "used_by": driver_on(name, running), "heard": heard.get(name), "probe": answers.get(name)}


def _port_data(port: SerialPort, answers: dict[str, ProbeAnswer], running: list[RunningDriver]) -> dict[str, Any]:
    import msgspec

    from skinware_drivers.finding.running import driver_on

    return {
        **msgspec.to_builtins(port),
        "name": port.name,
        "advice": port.advice(),
        "used_by": driver_on(port.path, running),
        "probe": answers.get(port.path),
    }


def _print_rules(buses: tuple[str, ...], as_json: bool) -> None:
    from skinware_drivers.finding.ports import PLACE, RELOAD, rules_for, shipped_rules

    _, ports, others = _chosen(buses, [])
    if others:
        raise click.UsageError(f"{others[0]} is not a serial port, and needs no udev rule")
    rules = rules_for(ports)
    if not rules:
        cli.warn("no serial device is plugged in by USB; these are the rules for the adapters that are usual")
        rules = shipped_rules()
    if as_json:
        print_json({"place": PLACE, "rules": rules, "then": list(RELOAD)})
    else:
        echo(rules, nl=False)
        cli.warn(f"to use them: skin-find --udev | sudo tee {PLACE}; {'; '.join(RELOAD)}")


def main() -> None:
    cli.run(command)
