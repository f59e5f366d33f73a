"""Reading in event loops: many readers and one thread, cancelled at any time, over the life and death of writers."""

from __future__ import annotations

import asyncio
import os
import threading
import warnings
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TypeVar

import pytest

import skinware.aio
from skinware import DriverReader, Sample, ServiceReader, ServiceWriter, Skin, aio
from skinware.errors import RequestFailed, RequestTimeout, ServiceTimeout, StructureChanged
from skinware.memory import futex
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill
from tests.core.services import SMALL, on_request, publish

T = TypeVar("T")
Reader = skinware.aio.Reader[Sample]


async def soon(what: Awaitable[T]) -> T:
    return await asyncio.wait_for(what, 60)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():  # noqa: ASYNC110, nobody tells
            await asyncio.sleep(0.001)


async def until_asleep() -> None:
    """Until a coroutine waits."""
    await until(lambda: len(aio._of_process._waits) == 1)


def test_a_skin_is_iterated_and_read() -> None:
    async def main() -> None:
        async with skinware.aio.Skin() as skin:
            with pytest.raises(ServiceTimeout, match="no driver"):
                await skin.read(timeout_s=0)
            with FakeSkin("arm", fake_structure(1, 1)) as arm:
                arm.publish()
                snapshot = await soon(skin.read())
                assert snapshot.layout.drivers == ("arm",)
                task = asyncio.create_task(skin.read(newer_than=snapshot, timeout_s=None))
                await until_asleep()
                arm.publish()
                assert (await soon(task)).samples[0].sequence == 2
                seen = 0
                async for snapshot in skin:
                    assert snapshot.samples[0].sequence == seen + 2
                    seen += 1
                    arm.publish()
                    if seen == 20:
                        break
                assert (
                    (await soon(anext(skin.samples(100, max_age_s=60, align=True))))
                    .fresh("pressure", max_age_s=60)
                    .all()
                )
                with pytest.raises(ServiceTimeout, match="too old: arm"):
                    await skin.read(max_age_s=0, timeout_s=0.01)

    asyncio.run(main())


def test_many_readers_wait_in_one_thread() -> None:
    """More of them than one system call can wait for."""

    async def main() -> None:
        with ServiceWriter("x", SMALL) as writer:
            publish(writer, 1)
            readers = [Reader(ServiceReader("x", announce=False)) for _ in range(futex.MAX_WORDS + 10)]
            first = [await reader.read() for reader in readers]
            tasks = [
                asyncio.create_task(reader.read(newer_than=frame, timeout_s=60))
                for reader, frame in zip(readers, first, strict=True)
            ]
            await asyncio.sleep(0.2)
            publish(writer, 2)
            assert [frame.sequence for frame in await asyncio.gather(*tasks)] == [2] * len(readers)
            assert [thread.name for thread in threading.enumerate()].count("skinware wake-ups") == 1
            for reader in readers:
                reader.close()
                reader.close()

    asyncio.run(main())
    assert "skinware wake-ups" not in [thread.name for thread in threading.enumerate()]


def test_waiting_wakes_the_thread_only_for_what_is_new(monkeypatch: pytest.MonkeyPatch) -> None:
    """No polling: over many slices of 50 ms without a frame the thread looks a few times, not twenty times a second."""
    looks = 0
    look = aio.Wakeups._look

    def counted(self: aio.Wakeups) -> list[aio.WakeWord]:
        nonlocal looks
        looks += 1
        return look(self)

    monkeypatch.setattr(aio.Wakeups, "_look", counted)
    slices = 0
    wait = aio.Wakeups.wait

    async def sliced(self: aio.Wakeups, words: list[aio.WakeWord], timeout_s: float) -> None:
        nonlocal slices
        slices += 1
        await wait(self, words, timeout_s)

    monkeypatch.setattr(aio.Wakeups, "wait", sliced)

    async def main() -> None:
        with ServiceWriter("x", SMALL) as writer:
            publish(writer, 1)
            async with Reader(ServiceReader("x")) as reader:
                frame = await reader.read()
                task = asyncio.create_task(reader.read(newer_than=frame, timeout_s=None))
                await until(lambda: slices >= 40)
                publish(writer, 2)
                await soon(task)

    asyncio.run(main())
    assert looks < slices / 2


def test_a_cancelled_wait_leaves_everything_as_it_was() -> None:
    async def main() -> None:
        with ServiceWriter("x", SMALL) as writer:
            publish(writer, 1)
            async with Reader(ServiceReader("x")) as reader:
                frame = await reader.read()
                for _ in range(20):
                    task = asyncio.create_task(reader.read(newer_than=frame, timeout_s=None))
                    await until_asleep()
                    task.cancel()
                    with pytest.raises(asyncio.CancelledError):
                        await task
                    assert aio._of_process._waits == []
                with pytest.raises(TimeoutError):
                    await asyncio.wait_for(reader.read(newer_than=frame, timeout_s=None), 0.02)
                publish(writer, 2)
                assert (await soon(reader.read(newer_than=frame))).sequence == 2
                assert reader.sync.missed == 0

    asyncio.run(main())


def test_two_event_loops_do_not_mind_each_other() -> None:
    seen: list[int] = []

    async def look() -> None:
        async with Reader(ServiceReader("x")) as reader:
            async for frame in reader:
                seen.append(frame.sequence)
                if frame.sequence >= 30:
                    return

    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        threads = [threading.Thread(target=asyncio.run, args=(look(),)) for _ in range(2)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            publish(writer, 1)
            threads[0].join(0.001)
    assert seen.count(1) <= 2
    assert len(seen) >= 2


@pytest.mark.thorough
def test_a_killed_writer_is_told_of_and_its_successor_is_found() -> None:
    async def main() -> None:
        with fake_process("fake") as process:
            async with skinware.aio.Reader(DriverReader("fake")) as reader:
                frames = reader.samples(timeout_s=60)
                assert not (await anext(frames)).stale
                kill(process)
                with pytest.raises(ServiceTimeout, match="its writer is dead"):
                    await soon(_all(reader.samples(timeout_s=0.1)))
                task = asyncio.create_task(reader.read(newer_than=reader.sync.newest_position, timeout_s=60))
                await until_asleep()
                with FakeSkin("fake") as fake:
                    fake.publish()
                    assert (await soon(task)).sequence == 1
                    fake.writer.restructure(fake_structure(1, 1))
                    with pytest.raises(StructureChanged):
                        await soon(reader.read(newer_than=reader.sync.newest_position, timeout_s=60))
                    with pytest.raises(StructureChanged):
                        await soon(_all(reader.samples(200)))

    asyncio.run(main())


async def _all(frames: AsyncIterator[object]) -> None:
    async for _ in frames:
        pass


def test_a_successor_of_which_nobody_tells_is_found() -> None:
    """Somebody removed the file: the old one is not marked, and nobody is woken."""

    async def main() -> None:
        with ServiceWriter("x", SMALL) as writer:
            publish(writer, 1)
            async with Reader(ServiceReader("x")) as reader:
                frame = await reader.read()
                task = asyncio.create_task(reader.read(newer_than=frame, timeout_s=60))
                await until_asleep()
                for path in (writer.namespace.ring_path("x"), writer.namespace.path / "x.lock"):
                    path.unlink()
                with ServiceWriter("x", SMALL) as successor:
                    publish(successor, 2)
                    assert (await soon(task)).generation == successor.generation

    asyncio.run(main())


def test_requests_are_awaited() -> None:
    async def main() -> None:
        async with Reader(ServiceReader("x")) as reader:
            assert await reader.call("add", a=1, b=2) == 3
            with pytest.raises(RequestFailed, match="the motor is hot"):
                await reader.call("fail")
            assert (await reader.request()).column("values")[0] == 1
            assert (await reader.request()).column("values")[0] == 2

    with on_request():
        asyncio.run(main())


def test_a_writer_that_does_not_answer_is_not_waited_for_too_long() -> None:
    async def main() -> None:
        with ServiceWriter("x", SMALL) as writer:
            publish(writer, 1)
            writer.request_server()
            async with Reader(ServiceReader("x")) as reader:
                with pytest.raises(RequestTimeout, match=r"x: no answer to 'acquire' within 0\.02 s"):
                    await reader.request(timeout_s=0.02)

    asyncio.run(main())


def test_the_child_of_a_fork_waits_in_a_thread_of_its_own() -> None:
    async def wait_once(name: str, between: Callable[[], None]) -> None:
        with ServiceWriter(name, SMALL) as writer:
            publish(writer, 1)
            async with Reader(ServiceReader(name)) as reader:
                task = asyncio.create_task(reader.read(newer_than=await reader.read(), timeout_s=60))
                await until_asleep()
                thread = aio._of_process._thread
                assert thread is not None
                assert thread.is_alive()
                await asyncio.to_thread(between)
                publish(writer, 2)
                await soon(task)

    def fork() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of Python itself, about threads and forks
            child = os.fork()
        if not child:
            try:
                asyncio.run(wait_once("child", lambda: None))
                os._exit(0)
            finally:
                os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0

    asyncio.run(wait_once("parent", fork))


def test_a_skin_of_no_driver_waits_for_one() -> None:
    async def main() -> None:
        async with skinware.aio.Skin(Skin(drivers=["arm"])) as skin:
            task = asyncio.create_task(skin.read(timeout_s=60))
            await until_asleep()
            with FakeSkin("arm", fake_structure(1, 1)) as arm:
                arm.publish()
                assert (await soon(task)).layout.drivers == ("arm",)

    asyncio.run(main())
