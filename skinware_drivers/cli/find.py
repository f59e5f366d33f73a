"""``skin-find``: what is on the buses and ports of this machine."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json, style
from skinware.text import count_text, plural, words, wrapped
from skinware_drivers.bus_names import BusName, parse_bus_name

if TYPE_CHECKING:
    from skinware_drivers.finding.interfaces import CanInterface
    from skinware_drivers.finding.looking import HeardOnBus, ProbeAnswer
    from skinware_drivers.finding.ports import SerialPort
    from skinware_drivers.finding.running import RunningDriver

_WIDTH = 80
"""Columns of the text for people."""
_MOST_CLASSES = 6


@cli.command(
    "skin-find",
    "skin-find                     CAN interfaces, serial ports",
    "skin-find can0 --probe        ask which devices are on can0",
    "skin-find dds://0             topics of DDS, and which driver reads them",
    "skin-find --udev              fixed names for the serial ports",
    "skin-find --json | jq '.can.interfaces[] | {name, up, bit_rate}'",
)
@click.argument("buses", nargs=-1, metavar="[BUS]...")
@cli.duration_option("Listen for SECONDS.", default="1")
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
    duration_s: float,
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
    found = asyncio.run(look(buses, duration_s, probe=probe, force=force, driver_names=driver_names))
    if as_json:
        print_json(found)
    else:
        echo("\n".join(as_text(found)))


async def look(
    buses: tuple[str, ...],
    listen_s: float,
    *,
    probe: bool = False,
    force: bool = False,
    driver_names: tuple[str, ...] = (),
) -> dict[str, Any]:
    import msgspec

    from skinware.errors import BusNotAvailable
    from skinware_drivers.can.controller import NO_CAN
    from skinware_drivers.finding.guess import known_drivers
    from skinware_drivers.finding.interfaces import NO_INTERFACE, can_interfaces, kernel_has_can
    from skinware_drivers.finding.looking import listen, topics_on
    from skinware_drivers.finding.running import driver_on, running_drivers
    from skinware_drivers.registry import make_bus

    drivers = known_drivers("can", driver_names)
    running = running_drivers()
    interfaces, ports, others = _chosen(buses, can_interfaces())
    networks = [name for name in others if BusName.of(name).is_only_asked]
    for name in networks:
        make_bus(name)  # refuses bad names, also without --probe
    buses_to_hear = [one.name for one in interfaces if one.up]
    buses_to_hear += [name for name in others if not BusName.of(name).is_only_asked]

    topics = {
        name: await asyncio.to_thread(topics_on, name, listen_s, known_drivers("serial", driver_names))
        for name in networks
        if BusName.of(name).interface in ("dds", "ros2")
    }
    listened = await asyncio.gather(*(listen(name, listen_s, drivers) for name in buses_to_hear))
    heard: dict[str, HeardOnBus] = {one.bus: one for one in listened}
    problems = [one.problem for one in listened if one.problem]
    if buses and problems:
        raise BusNotAvailable(problems[0])
    answers = await _ask(heard, ports, networks, running, force, driver_names) if probe else {}
    in_kernel, advice = kernel_has_can(), []
    if not buses and not interfaces:
        advice.append(NO_INTERFACE if in_kernel else NO_CAN)

    def on_bus(name: str) -> dict[str, Any]:
        owner = driver_on(name, running)
        return {"bus": name, "used_by": owner, "heard": heard.get(name), "probe": answers.get(name)}

    return {
        "can": {
            "in_kernel": in_kernel,
            "advice": advice,
            "interfaces": [
                {**msgspec.to_builtins(one), "advice": one.advice(), **on_bus(one.name)} for one in interfaces
            ],
        },
        "buses": [on_bus(name) | ({"topics": topics[name]} if name in topics else {}) for name in others],
        "ports": [
            {
                **msgspec.to_builtins(port),
                "name": port.name,
                "advice": port.advice(),
                "used_by": driver_on(port.path, running),
                "probe": answers.get(port.path),
            }
            for port in ports
        ],
    }


def _chosen(
    buses: tuple[str, ...], interfaces: list[CanInterface]
) -> tuple[list[CanInterface], list[SerialPort], list[str]]:
    """Return CAN interfaces, serial ports, and names of other buses; all of the machine if none is named."""
    from skinware.errors import BusNotAvailable
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
    from skinware_drivers.finding.guess import known_drivers
    from skinware_drivers.finding.looking import ProbeAnswer, ask, ask_port
    from skinware_drivers.finding.running import driver_on

    answers, of = {}, {medium: known_drivers(medium, driver_names) for medium in ("can", "serial", "modbus")}
    for name, one in heard.items():
        answers[name] = await ask(one, of["can"], force=force, owner=str(driver_on(name, running) or ""))
    for name in networks:
        owner = driver_on(name, running)
        refused = ProbeAnswer(name, refused=f"{owner} has it")
        medium = "modbus" if parse_bus_name(name).interface == "modbus" else "serial"
        answers[name] = refused if owner else await ask_port(name, of[medium])
    for port in ports:
        owner = driver_on(port.path, running)
        users = [f"{user.program} (pid {user.pid})" for user in port.users]
        if owner is not None or users:
            answers[port.path] = ProbeAnswer(port.path, refused=f"{owner or ', '.join(users)} has it")
        elif not port.may_open:
            answers[port.path] = ProbeAnswer(port.path, refused="you may not open it")
        else:
            answers[port.path] = await ask_port(port.path, of["serial"] | of["modbus"])
    return answers


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


def as_text(found: dict[str, Any]) -> list[str]:
    """Return the whole report, with colours, which ``echo`` takes out without a terminal."""
    can = found["can"]
    lines: list[str] = []
    if can["interfaces"] or can["advice"]:
        lines += [style("CAN interfaces of the kernel", underline=True)]
        for interface in can["interfaces"]:
            lines += ["", *_interface_lines(interface)]
        lines += _advice(can["advice"])
    for bus in found["buses"]:
        lines += ["", style(bus["bus"], underline=True), *_bus_lines(bus)]
    if found["ports"]:
        lines += ["", style("serial ports", underline=True)]
        for port in found["ports"]:
            lines += ["", *_port_lines(port)]
    elif not can["interfaces"] and not found["buses"]:
        lines += ["", "no serial port"]
    return lines[1:] if lines and not lines[0] else lines


def _interface_lines(one: dict[str, Any]) -> list[str]:
    state = style("up", fg="green") if one["up"] else style("down", fg="yellow")
    parts = [state, f"kernel driver {one['driver']}" if one["driver"] else one["kind"]]
    if one["bit_rate"]:
        parts.append(f"{one['bit_rate'] / 1000:g} kbit/s")
        parts += [f"data {one['data_bit_rate'] / 1000:g} kbit/s"] if one["data_bit_rate"] else []
    elif one["kind"] == "can":
        parts.append("no bit rate known")
    if one["state"]:
        parts.append(one["state"].lower())
    parts += ["FD" if one["is_fd"] else "no FD", f"queue {one['queue_length']}"]
    counts = one["statistics"]
    went = [f"received {count_text(counts['rx_packets'])}", f"sent {count_text(counts['tx_packets'])}"]
    troubles = {**counts, **one["controller_errors"]}
    went += [
        f"{words(name)} {count_text(count)}"
        for name, count in troubles.items()
        if count and not name.endswith("_packets")
    ]
    lines = [*_wrapped(f"{style(one['name'], bold=True)}  {', '.join(parts)}", first="")]
    return [*lines, *_wrapped(", ".join(went)), *_bus_lines(one), *_advice(one["advice"])]


def _bus_lines(bus: dict[str, Any]) -> list[str]:
    lines = []
    if bus["used_by"] is not None:
        lines += _wrapped(f"{bus['used_by']} runs on it")
    heard, probe, topics = bus["heard"], bus["probe"], bus.get("topics")
    for one in sorted(topics or (), key=lambda each: not each.drivers):
        readers = f"; read by {', '.join(one.drivers)}" if one.drivers else ""
        lines += _wrapped(f"{one.topic}: {one.type_name}, {plural(one.publishers, 'publisher')}{readers}")
    if topics == []:
        lines += _wrapped("no topic is published in this domain; a robot's network is named as ?interface=eth0")
    if (
        topics is None
        and heard is None
        and probe is None
        and bus["used_by"] is None
        and BusName.of(bus["bus"]).is_only_asked
    ):
        lines += _wrapped(
            f"not opened, because a connection may change what a device does; to ask which device is on it:"
            f" skin-find {bus['bus']} --probe"
        )
    if heard is not None and heard.problem:
        lines += _advice([heard.problem])
    elif heard is not None:
        load = f", {100 * heard.load:.0f} % of the bus' time" if heard.load is not None and heard.frames else ""
        what = f"{plural(heard.frames, 'frame')} ({heard.rate_hz:,.0f} a second{load})" if heard.frames else "nothing"
        errors = f", {plural(heard.error_frames, 'error frame')}" if heard.error_frames else ""
        errors += f"; the controller is {heard.trouble}" if heard.trouble else ""
        lines += _wrapped(f"heard in {heard.duration_s:.1f} s: {what}{errors}")
        for one in heard.classes[:_MOST_CLASSES]:
            span = f"{one.first:X}" if one.first == one.last else f"{one.first:X} to {one.last:X}"
            which = f"{plural(one.identifiers, 'identifier')}, {span}"
            lines += _wrapped(f"{one.name}: {plural(one.frames, 'frame')} of {which}", first="    ")
        for one in heard.guesses:
            share = "all frames" if one.share == 1 else f"{100 * one.share:.0f} % of the frames"
            patches = ", ".join(one.patches)
            how = "looks like" if one.likely else "or perhaps"
            name = style(one.driver, bold=one.likely)
            lines += _wrapped(f"{how} {name}{'' if one.likely else '?'}: {patches} ({share})")
        if heard.frames and not heard.guesses:
            lines += _wrapped("no installed driver knows these frames")
        if not heard.frames and probe is None and bus["used_by"] is None:
            lines += _wrapped(f"to ask which devices are on it: skin-find {bus['bus']} --probe")
    return lines + _probe_lines(probe)


def _probe_lines(probe: Any) -> list[str]:
    if probe is None:
        return []
    if probe.refused:
        return _wrapped(f"not asked: {probe.refused}")
    lines = []
    for text in probe.answers.values():
        lines += _wrapped(f"answers: {text}")
    for driver, text in probe.problems.items():
        lines += _wrapped(f"{driver} could not ask: {text}")
    return lines or _wrapped(f"no answer (asked by {', '.join(probe.asked)})")


def _port_lines(port: dict[str, Any]) -> list[str]:
    usb = port["usb"]
    parts = [port["name"]]
    if usb is not None:
        parts.append(f"{usb['vendor_id']}:{usb['product_id']}")
        parts.append(f"serial number {usb['serial_number']}" if usb["serial_number"] else "no serial number")
    if port["driver"]:
        parts.append(f"kernel driver {port['driver']}")
    lines = _wrapped(f"{style(port['path'], bold=True)}  {', '.join(parts)}", first="")
    for link in port["links"]:
        lines.append(f"  {link}")
    if port["used_by"] is not None:
        lines += _wrapped(f"{port['used_by']} runs on it")
    elif port["users"]:
        lines += _wrapped("in use by " + ", ".join(f"{user['program']} (pid {user['pid']})" for user in port["users"]))
    elif not port["users_known"]:
        lines += _wrapped("whether a program of another user has it open is not known")
    return [*lines, *_advice(port["advice"]), *_probe_lines(port["probe"])]


def _advice(texts: list[str]) -> list[str]:
    """Return problems and what to do, with marks; the commands can be copied as they stand."""
    lines = []
    for text in texts:
        why, colon, commands = text.partition(": sudo ")
        mark = style("!", fg="yellow")
        lines += _wrapped(f"{mark} {why}{':' if colon else ''}")
        if colon:
            lines += [f"      sudo {command}" for command in commands.replace("; sudo ", ";").split(";")]
    return lines


def _wrapped(text: str, first: str = "  ") -> list[str]:
    return wrapped(first + text, _WIDTH)


main = partial(cli.run, command)
