"""A robot's files are read a second time, by other means: set-ups of its boards, and places of its taxels.

Written from protocol notes and robotology's documentation, with ElementTree and no code of
``skinware_drivers.icub``: if both agree, a mistake of one author is unlikely. It reads good files only.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

Triple = tuple[float, float, float]


@dataclass
class Board:
    """What a board is in the end.

    Attributes:
        settings: skin type, period in ms, no-load value.
        triangles: shift and converter offset of those that are switched on.
    """

    settings: tuple[int, int, int]
    triangles: dict[int, tuple[int, int]] = field(default_factory=dict)


@dataclass
class Device:
    """A skin device: its boards by (patch, address), in the order of the robot's index."""

    name: str
    file: Path
    boards: dict[tuple[int, int], Board]
    old: dict[str, list[int]]


def devices(folder: Path) -> Iterator[Device]:
    """All skin devices of a robot."""
    for path in sorted(folder.rglob("*.xml")):
        root = _xml(path)
        for element in [root] if root.tag == "device" else root.iter("device"):
            if element.get("type") in ("canBusSkin", "embObjSkin"):
                yield _device(path, element)


def ports(folder: Path, device: Device) -> dict[str, tuple[int, int, int]]:
    """First and last index in the device, and first in the body part, by body part."""
    for path in sorted(folder.rglob("*.xml")):
        wrapper = _xml(path)
        if wrapper.get("type") != "skinWrapper":
            continue
        lists = {each.get("name"): each.findall("elem") for each in wrapper.iter("paramlist")}
        if [elem.text.strip() for elem in lists["networks"] if elem.text] == [device.name]:
            rows = {elem.get("name", ""): list(map(int, (elem.text or "").split())) for elem in lists["ports"]}
            return {name: (row[0], row[1], row[2]) for name, row in rows.items()}
    return {}


def places(path: Path) -> dict[int, tuple[bool, Triple, Triple | None]]:
    """Whether it is a taxel, place and normal of every channel that has a place."""
    head, body = path.read_text().split("[calibration]")
    numbers = list(map(int, re.findall(r"-?\d+", head[head.index("(") :])))
    found = {}
    for channel, line in enumerate(line for line in body.splitlines() if line.strip()):
        x, y, z, *normal = map(float, line.split())
        if any((x, y, z, *normal)):
            is_taxel = channel >= len(numbers) or numbers[channel] >= 0
            length = math.sqrt(sum(n * n for n in normal))
            a, b, c = (n / length for n in normal) if length else (0, 0, 0)
            found[channel] = is_taxel, (x, y, z), (a, b, c) if length else None
    return found


def board_after(messages: Iterable[bytes]) -> Board:
    """What a board's firmware makes of the messages of the new set-up."""
    board = Board((-1, -1, -1))
    for message in messages:
        if message[0] == 0x4D:
            board = Board((message[1], message[2], message[3]))
        elif message[0] == 0x50:
            for triangle in range(message[1], message[2] + 1):
                board.triangles.pop(triangle, None)
                if message[4] & 1:
                    board.triangles[triangle] = (message[3], message[5] | message[6] << 8)
    return board


def _xml(path: Path) -> ET.Element:
    text = re.sub(r"<!--.*?-->", "", path.read_text(), flags=re.DOTALL)
    return ET.fromstring(re.sub(r"xi:include", "include", text).encode())


def _device(path: Path, element: ET.Element) -> Device:
    params, groups = _flat(path, element)
    name = element.get("name", "")
    if element.get("type") == "canBusSkin":
        buses = {int(params["canDeviceNum"]): _numbers(params["skinCanIds"])}
    else:
        buses = {patch: _numbers(groups["patches"].get(f"skinCanAddrsPatch{patch}", "")) for patch in (2, 1)}
    if "defaultCfgBoard" not in groups:
        old = {key: _numbers(value) for key, value in params.items() if key[:3] in ("4C_", "4E_")}
        nothing = Board((-1, -1, -1))
        return Device(name, path, {(patch, b): nothing for patch, bs in buses.items() for b in bs}, old)
    boards = {}
    for patch, addresses in buses.items():
        for address in addresses:
            boards[patch, address] = board_after(_messages(groups, patch, address))
    return Device(name, path, boards, {})


def _messages(groups: dict[str, dict[str, str]], patch: int, address: int) -> Iterator[bytes]:
    """In the order in which the robot sends them."""
    board, triangle = groups["defaultCfgBoard"], groups["defaultCfgTriangle"]
    period_ms, skin_type, no_load = (_numbers(board[key])[0] for key in ("period", "skinType", "noLoad"))
    yield bytes((0x4D, skin_type, period_ms, no_load))
    shift, offset = (_numbers(triangle[key])[0] for key in ("shift", "cdcOffset"))
    yield bytes((0x50, 0, 15, shift, triangle["enabled"].split()[0] in ("true", "1"), offset & 255, offset >> 8))
    for number, first, last, period_ms, skin_type, no_load in _sets(groups, "specialCfgBoards", "boardSetCfg"):
        if number == patch and first <= address <= last:
            yield bytes((0x4D, skin_type, period_ms, no_load))
    for row in _sets(groups, "specialCfgTriangles", "triangleSetCfg"):
        number, board_address, first, last, enabled, shift, offset = row
        if (number, board_address) == (patch, address):
            yield bytes((0x50, first, last, shift, enabled != 0, offset & 255, offset >> 8))


def _sets(groups: dict[str, dict[str, str]], name: str, prefix: str) -> list[list[int]]:
    group = groups.get(name, {})
    count = _numbers(group.get("numOfSets", "0"))[0]
    return [_numbers(group[f"{prefix}{n}"]) for n in range(1, count + 1) if f"{prefix}{n}" in group]


def _flat(path: Path, element: ET.Element) -> tuple[dict[str, str], dict[str, dict[str, str]]]:
    """Parameters and groups, with those of included files; of equal names the first counts."""
    params: dict[str, str] = {}
    groups: dict[str, dict[str, str]] = {}
    for child in element:
        inner: tuple[dict[str, str], dict[str, dict[str, str]]] = {}, {}
        if child.tag == "param":
            params.setdefault(child.get("name", ""), child.text or "")
        elif child.tag == "group":
            group = groups.setdefault(child.get("name", ""), {})
            for param in child.findall("param"):
                group.setdefault(param.get("name", ""), param.text or "")
        elif child.tag == "include" or child.get("file"):
            name = child.get("href") or child.get("file") or ""
            files = [folder / name for folder in path.parents if (folder / name).is_file()]
            inner = _flat(files[0], _xml(files[0])) if files else inner  # relative to the file or to the robot
        elif child.tag == "params":
            inner = _flat(path, child)
        params = {**inner[0], **params}
        groups = {**inner[1], **groups}
    return params, groups


def _numbers(text: str) -> list[int]:
    return [int(word, 0) for word in text.replace('"', " ").split()]
