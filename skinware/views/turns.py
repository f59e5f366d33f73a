"""Make the turns that one viewer gets: a header and arrays, with everything that is new since its last turn.

A turn is the length of its header (uint32, little endian), the header (JSON, padded with spaces so that the blobs
begin at a multiple of 8), and the blobs, each padded to 8 bytes; the header names each as ``[offset, length]``, in
bytes from the first one.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S, now_ns
from skinware.tactile.contacts import MOST
from skinware.tactile.contacts_service import ContactsSample
from skinware.tactile.source_service import Source
from skinware.tactile.tracking import ContactKind
from skinware.text import why_text
from skinware.views import looks
from skinware.views.following import ShownDriver
from skinware.views.live import are_on
from skinware.views.plots import Plots
from skinware.views.quantities import Newest, Quantity
from skinware.views.recorded_plots import RecordedPlots
from skinware.views.scene import Scene
from skinware.views.shows import Show
from skinware.views.tree import problem_of_all, problems_of, state_of, worst_first

PROTOCOL = "skinware.view.2"
_ALIGNMENT = 8
_STATE_EVERY_NS = NS_PER_S
_EXACT_EVERY_NS = NS_PER_S // 4
"""People read no more numbers."""
_MOST_QUESTIONS = 64
_OF_CONTACT = ("frame", "cop_m", "normal", "velocity_m_s", "kind", "id", "load", "area_m2", "age_s")


class Blobs:
    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, array: npt.NDArray[Any], dtype: str) -> list[int]:
        data = np.ascontiguousarray(array, dtype).tobytes()
        at = [self._size, len(data)]
        padded = -len(data) % _ALIGNMENT
        self._parts += [data, bytes(padded)]
        self._size += len(data) + padded
        return at

    def under(self, header: dict[str, Any]) -> bytes:
        text = msgspec.json.encode(header)
        text += b" " * (-(4 + len(text)) % _ALIGNMENT)
        return b"".join([len(text).to_bytes(4, "little"), text, *self._parts])


class _Got:
    """One driver as a viewer has it: its newest change, statuses by type, and contacts with their source."""

    def __init__(self) -> None:
        self.change: tuple[int, int] | None = None
        self.status: dict[str, bytes] = {}
        self.contacts: tuple[tuple[object, ...], list[dict[str, Any]]] = (), []
        self.source: tuple[Source | None, bool] = None, False  # of contacts, and whether they are on the driver


class Viewer:
    """One viewer of a show: its look, its questions, and what it has got so far.

    Attributes:
        wanted: turns that it has asked for, and waits for.
        sent_s: when it got its last turn, CLOCK_MONOTONIC.
    """

    def __init__(self, show: Show) -> None:
        self.look, self.wanted, self.sent_s = looks.Look(), 0, 0.0
        self.show = show
        self._sent: dict[str, Any] = {}  # of the replays
        self._number = 0
        self._edition = -1
        self._got: defaultdict[int, _Got] = defaultdict(_Got)  # by the driver's number
        self._state_due_ns = 0
        self._exact_due_ns: int | None = None  # 0: they are asked for
        self._known: list[Any] = []
        self._exact: list[tuple[int, int]] = []
        self._questions: list[looks.Names] = []
        self.plots = RecordedPlots(self.show.follower, show.played) if show.played else Plots(self.show.follower)
        self._error: str | None = None

    def obey(self, operation: looks.Operation) -> bool:
        """Carry out an operation that concerns this viewer alone; return whether it is one."""
        match operation:
            case looks.Choose():
                self.look.choose(operation)
                self._got.clear()
            case looks.Tare():
                self.look.tare()
                self._got.clear()
            case looks.Wipe():
                self.look.wipe(operation.action == "start")
                self._got.clear()
            case looks.Exact():
                self._exact, self._exact_due_ns = operation.sensors, 0
            case looks.Plot():
                self.plots.choose(operation.number, operation.lines, self._edition)
            case looks.Names() if len(self._questions) == _MOST_QUESTIONS:
                self.refuse(f"more than {_MOST_QUESTIONS} questions at once")
            case looks.Names():
                self._questions.append(operation)
            case looks.Replay():
                self.show.act(operation, self.refuse)
            case _:
                return False
        return True

    def refuse(self, why: str) -> None:
        self._error = why

    @property
    def has_news(self) -> bool:
        return (
            any(self._got[driver.number].change != _seen(driver) for driver in self.show.follower.drivers)
            or self._exact_due_ns == 0
            or bool(self._questions)
            or self.plots.has_news
            or self._error is not None
            or self._edition != self.show.follower.edition
            or self._sent != self._of_replays()
        )

    def turn(self, besides: dict[str, Any]) -> bytes:
        """Return everything that is new for this viewer.

        Args:
            besides: the part of the state that the server knows; its ``problems`` precede others of the same severity.
        """
        self._number += 1
        blobs = Blobs()
        header: dict[str, Any] = {"turn": self._number, "now_ns": str(now_ns())}
        if self._edition != self.show.follower.edition:
            self._edition = self.show.follower.edition
            header["skin"] = self._skin(blobs)
            self._got.clear()
        pictures = []
        for driver in self.show.follower.drivers:
            if self._got[driver.number].change != _seen(driver):
                self._got[driver.number].change = _seen(driver)
                shown = self._picture(driver, blobs)
                pictures += [shown] if shown is not None else []
        if pictures:
            header |= {"pictures": pictures, "mode": self.look.mode}
        if self._exact_due_ns is not None and now_ns() >= self._exact_due_ns:
            self._exact_due_ns = now_ns() + _EXACT_EVERY_NS if self._exact else None
            header["exact"] = [exact for number, at in self._exact if (exact := self._exactly(number, at)) is not None]
        if self._questions:
            header |= self._answer(self._questions.pop(0))
        blocks = [
            block._asdict() | {"time_ns": blobs.add(block.time_ns, "<i8"), "values": blobs.add(block.values, "<f8")}
            for block in self.plots.blocks()
        ]
        if blocks:
            header["plots"] = {"missed": self.plots.missed, "blocks": blocks}
        if self._error is not None:
            header["error"], self._error = self._error, None
        replays = self._of_replays()
        header |= {key: news for key, news in replays.items() if self._sent.get(key) != news}
        self._sent = replays
        known = [besides["problems"], besides.get("marks"), besides["recording"] is None, self.show.problems]
        known += [driver.life for driver in self.show.follower.drivers]
        if now_ns() >= self._state_due_ns or known != self._known:
            self._state_due_ns, self._known = now_ns() + _STATE_EVERY_NS, known
            header["state"] = besides | self._state(besides.get("problems", []))
        return blobs.under(header)

    def _of_replays(self) -> dict[str, Any]:
        return {"replays": self.show.replays, "outlines": self.show.outlines}

    def _skin(self, blobs: Blobs) -> dict[str, Any]:
        follower, scene = self.show.follower, self.show.follower.scene
        of_live = [origin for origin in follower.origins if origin.recording is None]
        namespaces = [n for origin in of_live for n in (origin.namespace, origin.calm) if n is not None]
        return {
            "protocol": PROTOCOL,
            "namespaces": [namespace.name for namespace in namespaces],
            "names": list(next((origin.names for origin in follower.origins), ())),
            "recordings": [origin.recording for origin in follower.origins if origin.recording is not None],
            "posed": bool(follower.robot.poses),
            "drivers": [_driver(driver, scene, blobs) for driver in follower.drivers],
            "links": [
                {
                    "frame": mesh.frame,
                    "mesh": f"mesh/{number}",
                    "pose": (follower.robot.poses[mesh.frame] @ mesh.pose).ravel().tolist(),
                }
                for number, mesh in enumerate(follower.robot.meshes)
            ],
        }

    def _picture(self, driver: ShownDriver, blobs: Blobs) -> dict[str, Any] | None:
        picture, newest = self.look.picture(driver), driver.newest
        if picture is None or newest is None:
            return None
        quantity, frame = picture.quantity, newest.frame
        unit = "" if newest.motion is None else newest.motion.source.unit
        shown: dict[str, Any] = {
            "driver": driver.number,
            "type": quantity.name,
            "generation": str(driver.generation),
            "acquired_ns": str(frame.acquired_ns),
            "scale": picture.scale,
            "levels": blobs.add(picture.levels, "u1"),
            "contacts": self._contacts(driver, quantity, newest),
            "regions": [
                {"name": region.name, "value": region.load, "unit": unit, "touched": region.contacts > 0}
                for region in newest.motion or ()
            ],
        }
        if picture.shear is not None:
            shown |= {"shear": blobs.add(picture.shear, "i1"), "longest_shear": picture.longest_shear}
        if picture.totals is not None:
            shown["totals"] = blobs.add(picture.totals[-1], "<f4")
            if len(picture.totals) > 1:
                shown["between"] = blobs.add(picture.totals[:-1], "<f4")
        status, got = newest.marked[quantity.where], self._got[driver.number]
        if got.status.get(quantity.name) != (in_bytes := status.tobytes()):
            got.status[quantity.name] = in_bytes
            shown["status"] = blobs.add(status, "u1")
        return shown

    def _contacts(self, driver: ShownDriver, quantity: Quantity, newest: Newest) -> list[dict[str, Any]]:
        got, seen = self._got[driver.number], (newest.contacts_position, quantity.name, self._edition)
        if got.contacts[0] != seen:
            got.contacts = seen, self._touched(driver, quantity, newest.contacts)
        return got.contacts[1]

    def _touched(self, driver: ShownDriver, quantity: Quantity, frame: ContactsSample | None) -> list[dict[str, Any]]:
        if frame is None or frame.source.type_name != quantity.type.name or not frame.column("count")[0]:
            return []
        got = self._got[driver.number]
        if got.source[0] is not frame.source:
            got.source = frame.source, are_on(frame, driver.structure)
        if not got.source[1]:
            return []
        scene, source, contacts = self.show.follower.scene, frame.source, []
        filled = slice(0, min(int(frame.column("count")[0]), MOST))
        rows = zip(*(frame.column(name)[filled].tolist() for name in _OF_CONTACT), strict=True)
        for row, (frame_number, cop_m, normal, velocity_m_s, kind, *figures) in enumerate(rows):
            pose = scene.pose(driver.name, source.frames[frame_number] if frame_number >= 0 else "")
            position = (pose @ [*cop_m, 1.0])[:3].tolist()
            if not all(map(math.isfinite, position)):  # in the middle of its taxels as they are laid out
                laid_out = scene.of(driver.name, quantity.name).position
                position = laid_out[frame.column("contact_of") == row].mean(axis=0, dtype=np.float64).tolist()
            place = {
                "position": position,
                "normal": (pose[:3, :3] @ normal).tolist(),
                "speed": math.hypot(*velocity_m_s),
            }
            known = {"kind": ContactKind(kind).name.lower(), "unit": source.unit}
            contacts.append(dict(zip(_OF_CONTACT[5:], figures, strict=True)) | known | place)
        return contacts

    def _exactly(self, number: int, position: int) -> dict[str, Any] | None:
        """Return the exact value of a sensor; None for one that does not exist (any more)."""
        driver = self.show.follower.get(number)
        if driver is None or driver.newest is None or position >= driver.structure.n_sensors:
            return None
        frame, structure = driver.newest.frame, driver.structure
        of_type = next(t for t in structure.types if t.id == structure.sensor_type[position])
        raw = frame.values[position].item()
        time_ns = int(frame.group_time_ns[structure.sensor_group[position]])
        return {
            "driver": number,
            "position": position,
            "value": of_type.offset + of_type.scale * raw,
            "raw": raw,
            "age_ms": round((now_ns() - time_ns) / 1e6, 3) if time_ns else None,
            "status": int(driver.newest.marked[position]),
            "why": why_text(int(driver.newest.why[position])),
            "untouched": bool(frame.module_untouched[structure.sensor_module[position]]),
        }

    def _answer(self, question: looks.Names) -> dict[str, Any]:
        driver = self.show.follower.get(question.driver)
        quantity = None if driver is None else driver.quantity(question.type)
        if driver is None or quantity is None:
            self.refuse(f"no {question.type!r} of a driver {question.driver}")
            return {}
        names = driver.structure.sensor_names(quantity.type.name)
        return {"names": {"driver": driver.number, "type": quantity.name, "of": names}}

    def _state(self, problems: list[dict[str, Any]]) -> dict[str, Any]:
        texts = self.show.problems + ([] if self.show.follower.problem is None else [self.show.follower.problem])
        problems = [*problems, *map(problem_of_all, texts)]
        drivers = []
        for driver in self.show.follower.drivers:
            report = driver.report()
            drivers.append(state_of(driver, report))
            problems = problems + problems_of(driver, report)
        return {"drivers": drivers, "problems": worst_first(problems)}


def _seen(driver: ShownDriver) -> tuple[int, int]:
    return driver.generation, driver.changes


def _driver(driver: ShownDriver, scene: Scene, blobs: Blobs) -> dict[str, Any]:
    structure, pads = driver.structure, driver.quantities[0].pads
    types = []
    for quantity in driver.quantities:
        placed, index = scene.of(driver.name, quantity.name), quantity.index
        types.append(
            {
                "name": quantity.name,
                "unit": quantity.type.unit,
                "touch": quantity.is_touch,
                "total": quantity.total,
                "n": len(quantity),
                "index": blobs.add(index, "<u4"),
                "uid": blobs.add(structure.sensor_uid[index], "<u8"),
                "patch": blobs.add(structure.sensor_patch[index], "<u2"),
                "module": blobs.add(pads.of_sensor[index], "<u2"),
                "position": blobs.add(placed.position, "<f4"),
                "normal": blobs.add(placed.normal, "<f4"),
                "placed": placed.is_known,
                "neighbour_spacing_m": placed.spacing_m,
            }
        )
    patches = structure.module_patch[pads.module].tolist()
    return {
        "id": driver.number,
        "name": driver.name,
        "namespace": driver.origin.title,
        "generation": str(driver.generation),
        "type": driver.live.reader.driver_type,
        "types": types,
        "buses": list(structure.buses),
        "patches": [
            {"name": name, "bus": bus}
            for name, bus in zip(structure.patch_names, structure.patch_bus.tolist(), strict=True)
        ],
        "modules": [{"name": name, "patch": patch} for name, patch in zip(pads.names, patches, strict=True)],
        "bodies": [blobs.add(outline, "<f4") for outline in scene.outlines(driver.name)],
    }
