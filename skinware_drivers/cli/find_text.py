"""The output of ``skin-find`` for people, in lines of at most 80 columns."""

from __future__ import annotations

from typing import Any

from skinware.cli._terminal import style
from skinware.text import count_text, plural, words, wrapped
from skinware_drivers.bus_names import BusName

_WIDTH = 80
_MOST_CLASSES = 6


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
    if found["adapters"] or found["adapters_problem"]:
        lines += ["", style("other CAN adapters, by python-can", underline=True)]
        for adapter in found["adapters"]:
            details = ", ".join(f"{key} {value}" for key, value in adapter.details.items())
            lines += _wrapped(f"{style(adapter.bus, bold=True)}  {details}".rstrip(), first="")
        lines += _advice([found["adapters_problem"]] if found["adapters_problem"] else [])
    if found["ports"]:
        lines += ["", style("serial ports", underline=True)]
        for port in found["ports"]:
            lines += ["", *_port_lines(port)]
    elif not can["interfaces"] and not found["buses"] and not found["adapters"]:
        lines += ["", "no serial port and no other CAN adapter"]
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
    for one in topics or ():
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
