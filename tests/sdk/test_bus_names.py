"""Which bus a name means, however it is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinware_drivers.bus_names import BusName


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("can0", "socketcan:can0?filter=on"),
        ("slcan:/dev/nonsuch?bitrate=1", "slcan:/dev/nonsuch"),
        ("./port?baudrate=9600", "serial:./port"),
        ("serial?serial_number=A1", "serial:?baudrate=9600&serial_number=A1"),
        ("udp_multicast:239.0.0.1?port=43113&fd=true", "udp_multicast:239.0.0.1"),
        ("virtual:xela?seed=1&lose=0.1", "virtual:xela?lose=0.1&seed=1"),
    ],
)
def test_one_bus(one: str, other: str) -> None:
    assert BusName.of(one).place == BusName.of(other).place


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("can0", "can1"),
        ("can0", "slcan:can0"),
        ("serial?serial_number=A1", "serial?serial_number=B2"),
        ("udp_multicast:239.0.0.1?port=1", "udp_multicast:239.0.0.1?port=2"),
        ("virtual", "virtual?seed=1"),
        ("virtual?seed=1", "virtual?seed=2"),
        ("", "left=1"),  # a program may have called its buses so
    ],
)
def test_two_buses(one: str, other: str) -> None:
    assert BusName.of(one).place != BusName.of(other).place


def test_links_are_followed(tmp_path: Path) -> None:
    (tmp_path / "port").symlink_to("/dev/null")
    assert BusName.of(f"{tmp_path}/port").place == BusName.of("serial:/dev/null?baudrate=9600").place
