"""Write all evidence and findings as one Markdown text without secrets, to attach to an issue."""

from __future__ import annotations

import os
import pwd
import re
import socket
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from skinware.text import plural, printable
from skinware_drivers.doctor.evidence import Counted, DriverSeen

_PEOPLE = range(1000, 65534)
"""Numbers of accounts of people."""
_LEAST_NAME, _LEAST_VALUE = 3, 8
"""Least number of letters that are taken out: shorter words are in every text."""
_SECRET = re.compile(r"TOKEN|SECRET|PASS|KEY|AUTH|CREDENTIAL|COOKIE|SESSION", re.IGNORECASE)
_COMMON = ("root", "localhost", "skinware")
_TOKENS = (
    re.compile(r"(?i)\b(?:token|secret|password|passwd|api_?key|auth)\b(\s*[=:]\s*)\S+"),
    re.compile(r"\b(?:gh[a-z]_|github_pat_|glpat-|xox[a-z]-|sk-|AKIA)[\w-]{10,}"),
    re.compile(r"\beyJ[\w-]{8,}\.[\w-]+\.[\w-]*"),
    re.compile(r"(?<![\w/])(?=[\w+-]*\d)(?=[\w+-]*[A-Za-z])[\w+-]{32,}={0,2}"),
)
_ADDRESSES = (
    re.compile(r"\b[\w.+-]+@[\w-]+(?:\.[\w-]+)+"),
    re.compile(r"\b(?:[0-9A-Fa-f]{2}:){5}[0-9A-Fa-f]{2}\b"),
    re.compile(r"(?<![\w.])\d{1,3}(?:\.\d{1,3}){3}(?![\w.])"),
    re.compile(r"(?<![\w:])(?:[0-9a-fA-F]{1,4}:){3,7}[0-9a-fA-F]{1,4}(?![\w:])|(?<![\w:])[0-9a-fA-F:]*::[0-9a-fA-F:]+"),
    re.compile(r"(?<=://)[^\s/:@]+:[^\s/@]+(?=@)"),
)
_HOST = re.compile(r"(?<=://)(?:\[[^\]]*\]|[^/:?\s]+)|(?<=[?&]host=)[^&\s]+")
"""The host in the name of a bus."""
_PATH = re.compile(r"(?<![\w./:])/(?:[^\s/'\"`,;:()]+/)+(?=[^\s/'\"`,;:()])")
_KNOWN_PATHS = ("/dev/", "/sys/", "/proc/", "/etc/", "/usr/", "/run/")
"""Beginnings of paths that are the same on all machines."""


@dataclass(frozen=True)
class Secrets:
    """Texts in place of private words, where they stand as whole words, and of private texts everywhere."""

    words: Mapping[str, str] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_this_machine(cls, environment: Mapping[str, str] | None = None) -> Secrets:
        """Return names of people, their home folders, the name of the machine, and values of environment variables."""
        given = os.environ if environment is None else environment
        people = [one for one in pwd.getpwall() if one.pw_uid in _PEOPLE or one.pw_uid == os.geteuid()]
        homes = {one.pw_dir for one in people} | {str(Path.home()), given.get("HOME", "")}
        names = {one.pw_name for one in people} | {given.get(name, "") for name in ("USER", "LOGNAME", "SUDO_USER")}
        names |= {one.pw_gecos.partition(",")[0] for one in people}
        machine = socket.gethostname()
        words = dict.fromkeys((name for name in names if len(name) >= _LEAST_NAME), "<user>")
        words |= dict.fromkeys((name for name in {machine, machine.partition(".")[0]} if name), "<machine>")
        texts = dict.fromkeys((home for home in homes if home.count("/") > 0 and len(home) > 1), "<home>")
        for name, value in given.items():
            is_long = len(value) >= (_LEAST_NAME + 1 if _SECRET.search(name) else _LEAST_VALUE)
            if is_long and value not in names:
                texts.setdefault(value, f"<{name}>")
        return cls({word: place for word, place in words.items() if word.lower() not in _COMMON}, texts)


def scrubbed(text: str, secrets: Secrets) -> str:
    """Return a text without these secrets, and without tokens, addresses and names of folders."""
    for known, place in _longest_first(secrets.texts):
        text = text.replace(known, place)
    for known, place in _longest_first(secrets.words):
        text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(known)}(?![A-Za-z0-9])", place, text, flags=re.IGNORECASE)
    for pattern in _TOKENS:
        text = pattern.sub("<token>", text)
    for pattern in _ADDRESSES:
        text = pattern.sub("<address>", text)
    return _PATH.sub(lambda found: found[0] if found[0].startswith(_KNOWN_PATHS) else "/<folder>/", text)


class Disguise:
    """Take secrets, by default of this machine, out of names of buses and other texts; hosts become ``host1``."""

    def __init__(self, secrets: Secrets | None = None) -> None:
        self._secrets = secrets or Secrets.of_this_machine()
        self._hosts: dict[str, str] = {}

    def __call__(self, text: str) -> str:
        hidden = _HOST.sub(lambda found: self._hosts.setdefault(found[0], f"host{len(self._hosts) + 1}"), text)
        return scrubbed(hidden, self._secrets)


def _longest_first(of: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    return sorted(of.items(), key=lambda pair: -len(pair[0]))


def as_markdown(lines: Iterable[str], drivers: Iterable[DriverSeen], secrets: Secrets | None = None) -> str:
    """Return these lines of text and all counters of these drivers, without secrets."""
    written = ["# Report of skin-doctor", "", "```text", *lines, "```", ""]
    for driver in drivers:
        written += _driver(driver)
    return scrubbed("\n".join(map(printable, written)) + "\n", secrets or Secrets.of_this_machine())


def _driver(driver: DriverSeen) -> Iterator[str]:
    yield f"## Counters of driver {driver.name}"
    yield ""
    what = driver.driver_type or "unknown type"
    yield f"{what}, data path {driver.data_path}, {plural(driver.frames, 'frame')} seen."
    yield ""
    yield "```text"
    for bus in driver.buses:
        yield f"bus {bus.name}: {_counted(bus.counted)}"
        for sample in bus.samples:
            yield f"    not used, {sample}"
        for change in bus.changes[1:]:
            yield f"    at {change.time_s:.1f} s {change.state} {change.reason}".rstrip()
    for patch in driver.patches:
        fresh = f"{patch.fresh} of {patch.sensors} fresh"
        yield f"patch {patch.name}: {patch.state}, {fresh}, {_counted(patch.counted)}"
        for change in patch.changes[1:]:
            yield f"    at {change.time_s:.1f} s {change.state}"
    yield from ("```", "")


def _counted(counted: Counted) -> str:
    """Return the counters that are not 0: total (growth during the look)."""
    counts = [f"{name} {count} (+{counted.grown.get(name, 0)})" for name, count in counted.total.items() if count]
    return ", ".join(counts)
