"""The unified skin: several drivers that come, go, change and die, and the replica that threads look at."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from skinware import DriverWriter, Skin, Snapshot, Structure
from skinware.errors import Closed, ServiceNotFound, ServiceTimeout, StructureError
from skinware.realtime import now_ns
from skinware.threads import SkinReplica
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, kill


class Told:
    """What a skin said of its drivers."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def skin(self) -> Skin:
        return Skin(
            on_attach=lambda name, structure: self.lines.append(f"+{name} {structure.n_sensors}"),
            on_detach=lambda name, structure: self.lines.append(f"-{name} {structure.n_sensors}"),
            on_structure=lambda name, structure: self.lines.append(f"~{name} {structure.n_sensors}"),
        )


def publish(writer: DriverWriter, value: int) -> None:
    columns = writer.begin()
    columns["values"][:] = value
    columns["status"][:] = 0
    writer.commit(now_ns())


def test_a_callback_that_raises_costs_no_other(caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []

    def tell(name: str, _structure: Structure) -> None:
        told.append(name)
        raise RuntimeError(f"no window for {name}")

    skin = Skin(on_attach=tell, on_detach=tell)
    with skin, DriverWriter("a", fake_structure(1, 2)) as a, DriverWriter("b", fake_structure(1, 2)) as b:
        publish(a, 1)
        publish(b, 2)
        wait_until(lambda: skin.refresh().drivers == ("a", "b"))
        assert skin.read().raw("pressure").tolist() == [1] * 20 + [2] * 20
        b.close()
        wait_until(lambda: skin.refresh().drivers == ("a",))
    assert told == ["a", "b", "b"]
    assert caplog.text.count("failed; the skin goes on") == 3
    assert "no window for b" in caplog.text
    caplog.clear()  # what was logged holds the structure, and so the shared memory


def test_drivers_come_change_and_go() -> None:
    told = Told()
    small, large = fake_structure(1, 2), fake_structure(2, 2)
    with told.skin() as skin, DriverWriter("b", small) as b:
        assert skin.refresh().drivers == ()
        publish(b, 1)
        wait_until(lambda: skin.refresh().drivers == ("b",))
        with DriverWriter("a", small) as a:
            publish(a, 2)
            wait_until(lambda: skin.refresh().drivers == ("a", "b"))
            snapshot = skin.read()
            assert snapshot.raw("pressure").tolist() == [2] * 20 + [1] * 20
            assert snapshot.physical("temperature").tolist() == [1.0] * 4 + [0.5] * 4
            b.restructure(large)
            publish(b, 3)
            wait_until(lambda: skin.read().layout.structures[1].n_sensors == 48)
            assert snapshot.raw("pressure").tolist() == [2] * 20 + [1] * 20  # the old one stays readable
            assert skin.read().raw("pressure").tolist() == [2] * 20 + [3] * 40
        wait_until(lambda: skin.refresh().drivers == ("b",))
    assert told.lines == ["+b 24", "+a 24", "~b 48", "-a 24"]


def test_a_sensor_is_found_by_type_and_uid() -> None:
    with Skin() as skin, FakeSkin("a", fake_structure(1, 2)) as a, FakeSkin("b", fake_structure(1, 1)) as b:
        a.publish()
        b.publish()
        wait_until(lambda: len(skin.refresh().drivers) == 2)
        layout = skin.layout
        uids = layout.uids("pressure")
        assert layout.position("pressure", 1012, "a") == np.flatnonzero(uids == 1012)[0] == 10
        assert layout.position("pressure", 1000, "b") == 20
        assert layout.position("temperature", 1022) == 2  # only a has it
        with pytest.raises(StructureError, match="several drivers have a 'pressure' sensor with uid 0x3e8: a, b"):
            layout.position("pressure", 1000)
        with pytest.raises(StructureError, match="no 'pressure' sensor with uid 0x5 in this skin"):
            layout.position("pressure", 5)
        with pytest.raises(StructureError, match="of driver 'b'"):
            layout.position("temperature", 1022, "b")
        with pytest.raises(StructureError, match="no sensor type 'heat' in this skin; there are: pressure, temp"):
            layout.position("heat", 1)


def test_no_driver() -> None:
    with Skin() as skin:
        with pytest.raises(ServiceTimeout, match="no driver runs in namespace"):
            skin.read(timeout_s=0.0)
        with pytest.raises(ServiceNotFound, match="no driver 'a' in this skin now; there are: none"):
            skin.reader("a")
    with pytest.raises(Closed):
        skin.read()


def test_a_killed_driver_leaves_and_comes_back(namespace: Any) -> None:
    from tests.cli.fake_skin import fake_process

    told = Told()
    with told.skin() as skin, FakeSkin("living") as living:
        with fake_process("dying") as process:
            living.publish()
            wait_until(lambda: skin.refresh().drivers == ("dying", "living"))
            kill(process)
            wait_until(lambda: skin.refresh().drivers == ("living",))
        with fake_process("dying") as process:
            wait_until(lambda: skin.refresh().drivers == ("dying", "living"))
            before = skin.read()
            wait_until(lambda: skin.read().samples[0].sequence > before.samples[0].sequence)
            kill(process)
            wait_until(lambda: skin.refresh().drivers == ("living",))
        with FakeSkin("dying"):
            pass  # clears away what the killed one left
    assert [line.split()[0] for line in told.lines] == ["+living", "+dying", "-dying", "+dying", "-dying"] or [
        line.split()[0] for line in told.lines
    ] == ["+dying", "+living", "-dying", "+dying", "-dying"]


@pytest.mark.thorough
def test_a_replica_is_whole_for_every_thread() -> None:
    """Two drivers publish flat out, one of them changes its structure; four threads look at every element."""
    stop = threading.Event()
    torn: list[str] = []
    seen = [0] * 4

    def drive(name: str, structures: list[Structure]) -> None:
        with DriverWriter(name, structures[0], slots=4) as writer:
            number = 0
            while not stop.is_set():
                number += 1
                if number % 200 == 0:
                    writer.restructure(structures[number // 200 % len(structures)])
                publish(writer, number % 251)

    def look(which: int, replica: SkinReplica) -> None:
        known: Snapshot | None = None
        while not stop.is_set():
            try:
                known = replica.wait(newer_than=known, timeout_s=1.0)
            except (ServiceTimeout, Closed):
                continue
            for frame, structure in zip(known.samples, known.layout.structures, strict=True):
                if frame.structure is not structure or len(frame.values) != structure.n_sensors:
                    torn.append("structure")
                if len(set(frame.values.tolist())) != 1:
                    torn.append("values")
            seen[which] += 1

    structures = [fake_structure(1, 2), fake_structure(2, 2)]
    drivers = [
        threading.Thread(target=drive, args=("a", structures)),
        threading.Thread(target=drive, args=("b", structures[:1])),
    ]
    replica = SkinReplica()
    lookers = [threading.Thread(target=look, args=(i, replica)) for i in range(4)]
    for thread in [*drivers, *lookers]:
        thread.start()
    try:
        wait_until(lambda: min(seen) > 300, 100.0)
    finally:
        stop.set()
        for thread in [*drivers, *lookers]:
            thread.join()
        replica.stop()
    assert torn == []


def test_a_replica_that_has_nothing_says_so() -> None:
    replica = SkinReplica()
    assert replica.snapshot is None
    with pytest.raises(ServiceTimeout, match=r"nothing new on the skin within 0\.01 s"):
        replica.wait(timeout_s=0.01)
    replica.stop()
    with pytest.raises(Closed, match="has ended"):
        replica.wait()


def test_an_error_in_the_function_of_a_replica_ends_it_and_is_told() -> None:
    def fail(_: Snapshot) -> None:
        raise ValueError("my own mistake")

    with FakeSkin("a") as skin:
        skin.publish()
        replica = SkinReplica(function=fail)
        wait_until(lambda: replica.error is not None)
        with pytest.raises(ValueError, match="my own mistake"):
            replica.stop()
        snapshot = replica.snapshot
        assert snapshot is not None
        for known in (snapshot, None):
            with pytest.raises(Closed, match="my own mistake"):
                replica.wait(newer_than=known)
