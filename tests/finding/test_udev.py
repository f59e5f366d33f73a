"""udev rules: right in form (by the grammar of udev(7), and udevadm where it can tell), and of the right devices."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from skinware_drivers.finding.ports import RULES_FILE, rules_for, serial_ports, shipped_rules
from tests.finding.fakes import FakeMachine

_PAIR = re.compile(r'([A-Z_]+)(?:\{([^}]+)\})?(==|!=|\+=|-=|:=|=)"((?:[^"\\])*)"')
_MATCHES = {"ACTION", "KERNEL", "SUBSYSTEM", "DRIVER", "KERNELS", "SUBSYSTEMS", "DRIVERS", "ATTRS", "TAGS"}
_EITHER = {"ATTR", "ENV"}
_GIVES = {"SYMLINK", "GROUP", "MODE", "OWNER", "TAG", "GOTO", "LABEL", "IMPORT"}
_NEED_NAME = {"ATTR", "ATTRS", "ENV", "IMPORT"}

Rule = list[tuple[str, str, str, str]]


def parse(text: str) -> list[Rule]:
    """The rules of a file as (key, name, operator, value); fails the test at what udev would not take."""
    rules: list[Rule] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        rule: Rule = []
        for part in re.split(r",\s*(?=[A-Z_]+[{=!+:-])", line):
            match = _PAIR.fullmatch(part.strip())
            assert match, f"line {number}: {part}"
            key, name, operator, value = match[1], match[2] or "", match[3], match[4]
            assert bool(name) == (key in _NEED_NAME), f"line {number}: {part}"
            if key in _MATCHES:
                assert operator in ("==", "!="), f"line {number}: {part}"
            elif key in _GIVES:
                assert operator in ("=", "+=", ":="), f"line {number}: {part}"
            else:
                assert key in _EITHER, f"line {number}: {part}"
            rule.append((key, name, operator, value))
        rules.append(rule)
    labels = [value for rule in rules for key, _, _, value in rule if key == "LABEL"]
    for at, rule in enumerate(rules):
        for key, _, _, value in rule:
            if key == "GOTO":  # only forwards
                assert labels.count(value) == 1
                assert any(("LABEL", "", "=", value) in later for later in rules[at + 1 :])
    return rules


def udevadm_verifies(path: Path) -> None:
    """Since systemd 254."""
    if shutil.which("udevadm") and not subprocess.run(["udevadm", "verify", "--help"], capture_output=True).returncode:
        done = subprocess.run(["udevadm", "verify", str(path)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def fake(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path)


def test_the_parser_of_these_tests_refuses_what_udev_does() -> None:
    for bad in (
        'SUBSYSTEM="tty", MODE="0660"',
        'SUBSYSTEM=="tty" MODE="0660"',
        'MODE=="0660"',
        'ATTRS=="x"',
        'SYMLINK+="skin/"a"',
        'GOTO="nowhere"',
        "KERNEL==ttyUSB0",
        'KERNAL=="ttyUSB0"',
    ):
        with pytest.raises(AssertionError):
            parse(bad)


def test_the_shipped_rules_are_well_formed_and_give_names_and_access(tmp_path: Path) -> None:
    rules = parse(shipped_rules())
    gives = [pair for rule in rules for pair in rule]
    assert ("TAG", "", "+=", "uaccess") in gives
    assert ("GROUP", "", "=", "dialout") in gives
    assert ("MODE", "", "=", "0660") in gives
    assert ("ATTR", "latency_timer", "=", "1") in gives
    assert ("SYMLINK", "", "+=", "skin/$env{ID_SERIAL_SHORT}") in gives
    assert 60 < int(RULES_FILE[:2]) < 73
    path = tmp_path / RULES_FILE
    path.write_text(shipped_rules())
    udevadm_verifies(path)


def test_an_ftdi_adapter_gets_a_name_by_its_number_and_no_waiting(fake: FakeMachine, tmp_path: Path) -> None:
    fake.add_usb_port("ttyUSB0", "ftdi_sio", "0403", "6001", "A50285BI", product="FT232R")
    text = rules_for(serial_ports(fake.machine))
    name, latency = parse(text)
    same_device = [
        ("ATTRS", "idVendor", "==", "0403"),
        ("ATTRS", "idProduct", "==", "6001"),
        ("ATTRS", "serial", "==", "A50285BI"),
    ]
    assert all(pair in name and pair in latency for pair in same_device)
    assert ("SYMLINK", "", "+=", "skin/A50285BI") in name
    assert ("ENV", "ID_USB_INTERFACE_NUM", "==", "00") in name
    assert ("SUBSYSTEM", "", "==", "usb-serial") in latency
    assert ("ATTR", "latency_timer", "=", "1") in latency
    path = tmp_path / RULES_FILE
    path.write_text(text)
    udevadm_verifies(path)


def test_a_device_without_number_is_named_by_its_socket(fake: FakeMachine) -> None:
    fake.add_usb_port("ttyACM0", "cdc_acm", "1a86", "7523", place="3-2.1")
    (rule,) = parse(rules_for(serial_ports(fake.machine)))
    assert ("KERNELS", "", "==", "3-2.1") in rule
    assert ("SYMLINK", "", "+=", "skin/usb-3-2.1") in rule


def test_odd_serial_numbers_can_break_no_rule(fake: FakeMachine) -> None:
    fake.add_usb_port("ttyACM0", "cdc_acm", "2341", "0043", 'a"b*c\\ d', product='"\nSYMLINK')
    (rule,) = parse(rules_for(serial_ports(fake.machine)))
    assert ("ATTRS", "serial", "==", "a?b?c??d") in rule
    assert ("SYMLINK", "", "+=", "skin/a_b_c__d") in rule


def test_there_is_no_rule_for_what_is_not_on_usb(fake: FakeMachine) -> None:
    fake.add_uart("ttyS0", kind=4)
    assert rules_for(serial_ports(fake.machine)) == ""


def test_converters_of_every_hand_on_a_serial_port_are_known() -> None:
    """1A86:55D3, Paxini's converter board: riverfog7/paxini-utils, commit b381e6a."""
    [wch] = [rule for rule in parse(shipped_rules()) if ("ENV", "ID_VENDOR_ID", "==", "1a86") in rule]
    [models] = [value for key, name, _, value in wch if (key, name) == ("ENV", "ID_MODEL_ID")]
    assert {"7523", "55d3", "55d4"} <= set(models.split("|"))
