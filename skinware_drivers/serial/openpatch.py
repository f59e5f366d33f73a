"""Patches that speak the open patch protocol, and describe themselves; one patch on each serial line.

The protocol is docs/protocols/patch-serial.md; how to build such a patch, docs/how-to/openpatch.md.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from skinware.errors import BusError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers import Link, Match, Notice, Patch, operation
from skinware_drivers.serial import COBS, CRC32, Answers, Delimited, Field, Refused, SerialAdapter
from skinware_drivers.serial.openpatch_description import (
    ALL_MODULES,
    MAJOR,
    MINOR,
    MOST_PAYLOAD,
    BadDescription,
    Description,
    Greeting,
    Report,
    read_description,
)

log: logging.Logger = logging.getLogger("skinware.driver")

HELLO, DESCRIBE, START, STOP, PERIOD, ENABLE, TARE, STATUS = range(1, 9)
BOOT, REPORT, NOTE = 0x60, 0x61, 0x62
_REPLY = 0x40

_TIMEOUT_S, _TARE_TIMEOUT_S = 0.25, 3.0
_TRIES = 3
_TRIES_AFTER_RESET = 10  # opening a port resets many boards, which are deaf while their boot loader waits
_QUIET_NS = 10 * NS_PER_S  # between two lines of the log about one matter
_MOST_MATTERS = 50
_OTHER_DESCRIPTION = 8
_ANSWERS = Answers(
    "patch",
    {
        1: "it does not know this request",
        2: "the request is too short",
        3: "there is no such module or item",
        4: "the value is not one it can have",
        5: "it is busy",
        6: "its hardware failed",
        7: "it cannot do this",
        _OTHER_DESCRIPTION: "its description is not the one that was read",
    },
    offset=1,
)
_SEVERITIES = (logging.INFO, logging.WARNING, logging.ERROR)


class OpenPatchOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    rate_hz: Annotated[
        float, Meta(ge=0, le=1e6, description="cycles per second, as set in the patches; 0: leave each patch's own")
    ] = 0.0


class OpenPatchDriver(SerialAdapter[OpenPatchOptions]):
    framing = Delimited(COBS, maximum_body=MOST_PAYLOAD, checksum=CRC32, identifier=Field(0))
    payload_size = MOST_PAYLOAD  # of the protocol: that of the patch is known only after it was asked

    def __init__(self, options: OpenPatchOptions) -> None:
        super().__init__(options)
        self._description: Description | None = None
        self._crc = 0
        self._patch: Patch | None = None
        self._wanted_us = round(1e6 / options.rate_hz) if options.rate_hz else 0
        self._disabled: set[int] = set()
        self._number = 0
        self._n_samples: int | None = None  # taken since its reset, as it answered when it was last silent
        self._report: Report | None = None
        self._log: dict[str, tuple[int, int]] = {}  # matter -> (when it was logged, how often it occurred since)

    async def describe(self, link: Link) -> Sequence[Patch]:
        if link.listen_only:
            raise BusError("a patch says what it is only when it is asked: listening alone cannot find out")
        greeting = await self._greet(link)
        if self._patch is not None and greeting.crc == self._crc:
            return [self._patch]
        items = []
        for number in range(greeting.n_items):
            wanted = number.to_bytes(2, "little")
            answer = await self._ask(link, DESCRIBE, wanted)
            if answer[:2] != wanted:
                raise BadDescription(f"the patch was asked for item {number} and sent another")
            items.append(answer[2:])
        found = read_description(items, greeting.crc)
        link.log.info("%s, firmware %s", found.name, found.firmware or "of no version")
        self._description, self._crc, self._patch = found, greeting.crc, found.patch
        self.types, self.dtype, self.layout = found.types, found.dtype, found.layout
        self.period_s = (self._wanted_us or found.period_us) / 1e6
        self._disabled.clear()
        return [self._patch]

    async def configure(self, link: Link) -> None:
        if self._wanted_us:
            await self._set_period(link, self._wanted_us)
        for module in sorted(self._disabled):
            await self._ask(link, ENABLE, bytes((module, 0)))

    async def start(self, link: Link) -> None:
        self._n_samples = None
        try:
            await self._ask(link, START, self._crc.to_bytes(4, "little"))
        except Refused as error:
            if error.status == _OTHER_DESCRIPTION:
                self._changed(link)
            raise

    async def stop(self, link: Link) -> None:
        await self._ask(link, STOP)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Ask for the patch's name; no question disturbs a patch that streams."""
        asking = cls(OpenPatchOptions())
        await asking._greet(link, tries=_TRIES_AFTER_RESET)
        [patch] = await asking.describe(link)
        return f"open patch: {patch.name}"

    async def attend(self, link: Link) -> None:
        """Follow its announcements: restarts, reports and notes."""
        with link.follow(Match(BOOT), Match(REPORT), Match(NOTE)) as heard:
            while True:
                message = await heard.get()
                try:
                    if message.identifier == BOOT:
                        self._take_greeting(link, Greeting.read(message.payload))
                    elif message.identifier == REPORT:
                        self._take_report(link, Report.read(message.payload))
                    elif message.payload:
                        text = message.payload[1:].decode("utf-8", "backslashreplace")
                        text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
                        matter = f"note {text}" if len(self._log) < _MOST_MATTERS else "note"
                        self._say(link, _SEVERITIES[min(message.payload[0], 2)], matter, f"says: {text}")
                except BadDescription as error:
                    self._say(link, logging.WARNING, "announcement", str(error))

    async def probe(self, link: Link, patch: Patch) -> bool:  # noqa: ARG002
        """Return whether the silent patch has restarted; a patch that says that it streams has not.

        If it streams and has counted no sample since the last question, though some modules are on, its sampling
        hangs. If it has counted samples, this machine or the line is slow.
        """
        greeting = await self._greet(link, tries=1)
        if greeting.crc != self._crc:
            self._changed(link)
            return False
        if not greeting.streaming:
            self._say(link, logging.WARNING, "reset", f"was reset: {greeting.reset}, {greeting.uptime_s:g} s ago")
            return True
        report = Report.read(await self._ask(link, STATUS, tries=1))
        before, self._n_samples = self._n_samples, report.sent + report.dropped
        if self._n_samples == before and self._disabled != self._modules(ALL_MODULES):
            self._say(link, logging.WARNING, "sampling", "answers, but takes no samples: its sampling hangs")
        return False

    def _take_greeting(self, link: Link, greeting: Greeting) -> None:
        if self._patch is None:
            return
        self._say(link, logging.WARNING, "reset", f"was reset: {greeting.reset}, {greeting.uptime_s:g} s ago")
        if greeting.crc != self._crc:
            self._changed(link)
        else:
            self.tell(self._patch, Notice.RESTARTED)

    def _take_report(self, link: Link, report: Report) -> None:
        before, self._report = self._report, report
        if before is None or report.uptime_s < before.uptime_s:
            return
        dropped, bad = report.dropped - before.dropped, report.bad_requests - before.bad_requests
        if dropped > 0:
            self._say(link, logging.WARNING, "dropped", f"dropped {dropped} samples: its line is too slow for its rate")
        if bad > 0:
            self._say(link, logging.WARNING, "damaged", f"received {bad} damaged frames: look at cable and baud rate")

    def _changed(self, link: Link) -> None:
        self._say(link, logging.WARNING, "changed", "has changed: reading its description again")
        if self._patch is not None:
            self.tell(self._patch, Notice.CHANGED)

    def _say(self, link: Link, level: int, matter: str, text: str) -> None:
        """Log a line, at most one every ten seconds about one matter."""
        logged_ns, kept_back = self._log.get(matter, (-_QUIET_NS, 0))
        if now_ns() - logged_ns < _QUIET_NS:
            self._log[matter] = logged_ns, kept_back + 1
            return
        self._log[matter] = now_ns(), 0
        more = f" ({kept_back} more of these since)" if kept_back else ""
        log.log(level, "%s: %s %s%s", link.bus_name, self._patch.name if self._patch else "the patch", text, more)

    @operation()
    async def rate(self, link: Link, patches: Sequence[Patch], hz: float) -> float:  # noqa: ARG002
        """Set the cycles per second; return the rate that the patch has now."""
        if not 0 < hz <= 1e6:
            raise ValueError(f"{hz:g} Hz: give more than 0, up to 1000000")
        await self._set_period(link, round(1e6 / hz))
        return 1 / self.period_s

    @operation()
    async def enable(
        self,
        link: Link,
        patches: Sequence[Patch],  # noqa: ARG002
        on: bool = True,
        module: int = ALL_MODULES,
    ) -> None:
        """Switch a module, or all, on or off; modules that are off are published as masked."""
        modules = self._modules(module)
        await self._ask(link, ENABLE, bytes((module, on)))
        self._disabled = self._disabled - modules if on else self._disabled | modules

    @operation(sets_up=True)
    async def tare(
        self,
        link: Link,
        patches: Sequence[Patch],  # noqa: ARG002
        module: int = ALL_MODULES,
    ) -> None:
        """Take the present values of a module, or of all, as zero."""
        self._modules(module)
        await self._ask(link, TARE, bytes((module,)), timeout_s=_TARE_TIMEOUT_S, tries=1)

    @operation(looks=True)
    async def counts(self, link: Link, patches: Sequence[Patch]) -> dict[str, Any]:  # noqa: ARG002
        """Return the patch's counters: uptime_s, sent, dropped, bad_requests."""
        return asdict(Report.read(await self._ask(link, STATUS)))

    def _modules(self, module: int) -> set[int]:
        known = set(range(len(self._description.modules))) if self._description else set()
        if module == ALL_MODULES:
            return known
        if module not in known:
            raise ValueError(f"no module {module}: the patch has 0 to {len(known) - 1}, or {ALL_MODULES} for all")
        return {module}

    async def _set_period(self, link: Link, period_us: int) -> None:
        description = self._description
        if description is not None and not description.shortest_us <= period_us <= description.longest_us:
            lowest, highest = 1e6 / description.longest_us, 1e6 / description.shortest_us
            raise BusError(f"{1e6 / period_us:g} Hz: the patch can do {lowest:g} to {highest:g} Hz")
        answer = await self._ask(link, PERIOD, period_us.to_bytes(4, "little"))
        became_us = int.from_bytes(answer[:4], "little")
        if len(answer) < 4 or not became_us:
            raise BadDescription("the patch does not say which period it has now")
        self._wanted_us = became_us
        self.period_s = became_us / 1e6

    async def _greet(self, link: Link, tries: int = _TRIES) -> Greeting:
        return Greeting.read(await self._ask(link, HELLO, bytes((MAJOR, MINOR)), tries=tries))

    async def _ask(
        self, link: Link, request: int, arguments: bytes = b"", *, timeout_s: float = _TIMEOUT_S, tries: int = _TRIES
    ) -> bytes:
        """Send a request, again if necessary (every request can be repeated), and return the answer."""
        self._number = self._number % 255 + 1
        number = bytes((self._number,))
        answer = Match(_REPLY + request, prefix=number)
        reply = await link.request(request, number + arguments, answer, timeout_s=timeout_s, tries=tries)
        return _ANSWERS.result(request, reply.payload)
