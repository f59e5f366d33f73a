"""Services come, pause, change, die and return at random; writers and readers must do what a simple model says."""

from __future__ import annotations

import os
import secrets
import shutil
from dataclasses import dataclass, field

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    initialize,
    invariant,
    multiple,
    rule,
    run_state_machine_as_test,
)

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import (
    Closed,
    NameInUse,
    Paused,
    PeerGone,
    RequestRefused,
    RequestTimeout,
    ServiceNotFound,
    ServiceTimeout,
    StructureChanged,
)

pytestmark = pytest.mark.usefixtures("ring")

NAMES = ["a", "b"]
SHAPES = [1, 5]
SLOTS = 4


@dataclass
class Life:
    """The model of one generation: what was published, and what everybody may know of it."""

    shape: int
    before: int  # published by the generations before it
    sent: int = 0
    ended: bool = False


@dataclass
class Service:
    """The model of a name: its writer, and the generation that is found under it."""

    writer: ServiceWriter | None = None
    paused: bool = False
    lives: list[Life] = field(default_factory=list)
    found: Life | None = None
    published: int = 0

    def begin_life(self, shape: int) -> None:
        if self.found is not None:
            self.found.ended = True
        self.found = Life(shape, self.published)


@dataclass
class Reading:
    """The model of a reader: the generation it reads, where it is, and what it has taken and lost."""

    name: str
    reader: ServiceReader[Sample]
    life: Life
    taken: int = 0
    frames: int = 0
    lost: int = 0
    begun: bool = False
    moved: bool = False

    def go_over(self, to: Life) -> None:
        if self.begun:
            self.lost += to.before - self.life.before - self.taken
        self.life, self.taken = to, 0

    def follow(self, service: Service) -> bool:
        """Go over to the generation that is found now if this one has ended.

        Returns:
            False if there was one of another structure; from then on it stays where it is until it is reattached.
        """
        found = service.found
        if self.moved or not self.life.ended or found is None or found is self.life:
            return not self.moved
        self.moved = found.shape != self.life.shape
        if not self.moved:
            self.go_over(found)
        return not self.moved

    def take(self, sequence: int, frame: Sample) -> None:
        assert frame.sequence == sequence
        assert frame.column("values").tolist() == [sequence] * self.life.shape
        assert frame.stale == self.life.ended
        if self.begun:
            self.lost += max(0, sequence - self.taken - 1)
        self.frames += 1
        self.taken, self.begun = sequence, True
        assert (self.reader.statistics.frames, self.reader.missed) == (self.frames, self.lost)


class Lifecycle(RuleBasedStateMachine):
    """A writer's death is what the kernel makes of it: its descriptors are closed, its files stay."""

    readers = Bundle("readers")

    @initialize()
    def begin(self) -> None:
        self.namespace = Namespace(f"model-{os.getpid()}-{secrets.token_hex(4)}")
        self.namespace.create()
        self.services = {name: Service() for name in NAMES}
        self.readings: list[Reading] = []

    def teardown(self) -> None:
        for reading in self.readings:
            reading.reader.close()
        for name, service in self.services.items():
            if service.writer is not None:
                service.writer.close()
            elif service.found is not None:
                ServiceWriter(name, {"values": ("<u4", 1)}, namespace=self.namespace).close()
        left = {str(path.relative_to(self.namespace.path)) for path in self.namespace.path.rglob("*")}
        shutil.rmtree(self.namespace.path)
        assert left <= {"readers", *(f"{name}.lock" for name in NAMES)}

    # -- writers

    @rule(name=st.sampled_from(NAMES), shape=st.sampled_from(SHAPES))
    def create_or_revive(self, name: str, shape: int) -> None:
        service, columns = self.services[name], {"values": ("<u4", shape)}
        if service.writer is not None:
            with pytest.raises(NameInUse):
                ServiceWriter(name, columns, namespace=self.namespace)
            return
        service.writer = ServiceWriter(name, columns, namespace=self.namespace, slots=SLOTS)
        service.paused = False
        service.begin_life(shape)

    @rule(name=st.sampled_from(NAMES), count=st.integers(1, 2 * SLOTS))
    def publish(self, name: str, count: int) -> None:
        service = self.services[name]
        if service.writer is None or service.found is None:
            return
        if service.paused:
            with pytest.raises(Paused):
                service.writer.begin()
            return
        for _ in range(count):
            service.found.sent += 1
            service.published += 1
            service.writer.begin()["values"][:] = service.found.sent
            assert service.writer.commit(service.found.sent) == service.found.sent

    @rule(name=st.sampled_from(NAMES))
    def pause(self, name: str) -> None:
        service = self.services[name]
        if service.writer is not None:
            service.writer.pause()
            service.paused = True

    @rule(name=st.sampled_from(NAMES))
    def resume(self, name: str) -> None:
        service = self.services[name]
        if service.writer is not None:
            service.writer.resume()
            service.paused = False

    @rule(name=st.sampled_from(NAMES), shape=st.sampled_from(SHAPES))
    def restructure(self, name: str, shape: int) -> None:
        service = self.services[name]
        if service.writer is not None:
            service.writer.restructure({"values": ("<u4", shape)})
            service.begin_life(shape)

    @rule(name=st.sampled_from(NAMES))
    def serve_requests(self, name: str) -> None:
        service = self.services[name]
        if service.writer is None:
            return
        found = service.writer.requests()
        for _ in range(10):  # a turn may end between a request and its cancellation
            if all(request.cancelled for request in found):
                return
            found += service.writer.requests(1.0)
        raise AssertionError(f"requests that nobody made, or that were not cancelled: {found}")

    @rule(name=st.sampled_from(NAMES))
    def remove(self, name: str) -> None:
        service = self.services[name]
        if service.writer is None or service.found is None:
            return
        writer, service.writer = service.writer, None
        writer.close()
        service.found.ended, service.found = True, None
        for change in (writer.begin, writer.pause, writer.resume, lambda: writer.restructure({}), writer.requests):
            with pytest.raises(Closed):
                change()
        writer.close()

    @rule(name=st.sampled_from(NAMES))
    def die(self, name: str) -> None:
        service = self.services[name]
        if service.writer is None or service.found is None:
            return
        writer, service.writer = service.writer, None
        if writer._server is not None:
            writer._server.abandon()
        writer._ring.segment.descriptor.close()
        writer._name_lock.close()
        service.found.ended = True

    @rule(name=st.sampled_from(NAMES), everything=st.booleans())
    def files_are_removed(self, name: str, everything: bool) -> None:
        service = self.services[name]
        if service.writer is None or service.paused:
            return
        for path in (self.namespace.path / f"{name}{suffix}" for suffix in (".ring", ".lock", ".sock")):
            if path.suffix == ".ring" or everything:
                path.unlink(missing_ok=True)
        service.writer._next_file_check_ns = 0  # now instead of within a second
        assert service.found is not None
        service.begin_life(service.found.shape)
        self.publish(name, 1)
        with pytest.raises(NameInUse):
            ServiceWriter(name, {"values": ("<u4", 1)}, namespace=self.namespace)

    # -- readers

    @rule(target=readers, name=st.sampled_from(NAMES))
    def attach(self, name: str) -> object:
        life = self.services[name].found
        if life is None:
            with pytest.raises(ServiceNotFound):
                ServiceReader[Sample](name, namespace=self.namespace)
            return multiple()
        reading = Reading(name, ServiceReader[Sample](name, namespace=self.namespace), life)
        self.readings.append(reading)
        return reading

    @rule(reading=readers)
    def read(self, reading: Reading) -> None:
        compatible = reading.follow(self.services[reading.name])
        if reading.life.sent:
            reading.take(reading.life.sent, reading.reader.read(timeout_s=0))
            assert reading.reader.structure_changed != compatible
        else:
            with pytest.raises(ServiceTimeout if compatible else StructureChanged):
                reading.reader.read(timeout_s=0)

    @rule(reading=readers)
    def view(self, reading: Reading) -> None:
        reading.follow(self.services[reading.name])
        if reading.life.sent:
            with reading.reader.view() as frame:
                assert frame.valid
            reading.take(reading.life.sent, frame)
        else:
            with pytest.raises(ServiceTimeout), reading.reader.view():
                pass

    @rule(reading=readers)
    def read_in_order(self, reading: Reading) -> None:
        """What the ring still holds comes first, also of a generation that has ended."""
        service = self.services[reading.name]
        compatible = True
        if not (reading.begun and reading.taken < reading.life.sent):
            compatible = reading.follow(service)
        frames = reading.reader.in_order(timeout_s=0.06)  # longer than a slice: it looks around
        if reading.taken < reading.life.sent:
            wanted = reading.life.sent if not reading.begun else reading.taken + 1
            if wanted <= reading.life.sent - SLOTS:
                wanted = reading.life.sent - SLOTS + 2
            reading.take(wanted, next(frames))
        else:
            with pytest.raises(ServiceTimeout if compatible else StructureChanged):
                next(frames)

    @rule(reading=readers)
    def request_from_a_writer_that_does_not_listen(self, reading: Reading) -> None:
        service = self.services[reading.name]
        reading.follow(service)
        listens = service.writer is not None and service.writer._server is not None
        with pytest.raises(PeerGone if service.writer is None else RequestTimeout if listens else RequestRefused):
            reading.reader.request(timeout_s=0)

    @rule(reading=readers)
    def reattach(self, reading: Reading) -> None:
        found = self.services[reading.name].found
        if found is None:
            with pytest.raises(ServiceNotFound):
                reading.reader.reattach()
            return
        reading.reader.reattach()
        reading.moved = False
        if found is not reading.life:
            reading.go_over(found)

    @rule(reading=consumes(readers))
    def detach(self, reading: Reading) -> None:
        reading.reader.close()
        self.readings.remove(reading)
        for use in (reading.reader.read, reading.reader.view().__enter__, lambda: reading.reader.ask("acquire")):
            with pytest.raises(Closed):
                use()

    @invariant()
    def everybody_sees_who_lives(self) -> None:
        if not hasattr(self, "services"):
            return
        assert self.namespace.services() == sorted(name for name, s in self.services.items() if s.found is not None)
        for reading in self.readings:
            assert reading.reader.alive == (not reading.life.ended)
            if not reading.life.ended:
                assert reading.reader.paused == self.services[reading.name].paused


@pytest.mark.thorough
@pytest.mark.timeout(600)
def test_lifecycle(request: pytest.FixtureRequest) -> None:
    run_state_machine_as_test(
        Lifecycle,
        settings=settings(
            max_examples=int(os.environ.get("SKINWARE_TEST_EXAMPLES") or 200),
            stateful_step_count=40,
            deadline=None,
            database=None,
            report_multiple_bugs=False,
            print_blob=True,
            suppress_health_check=list(HealthCheck),
        ),
    )
