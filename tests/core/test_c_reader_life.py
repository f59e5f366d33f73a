"""skinware.h tells the life and death of a writer, at once and only once."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from skinware import ServiceWriter
from skinware.memory import file_layout
from tests.core.c_programs import lone_writer, run, talking
from tests.core.workers import kill

pytestmark = pytest.mark.usefixtures("process_server")

LONG_MS = 600_000
"""Nothing here may wait that long: what is told in spite of it was noticed, not waited for."""


def test_a_killed_writer_is_noticed_and_a_restart_followed(any_program: Path) -> None:
    with lone_writer() as process, talking(any_program, "follow", "x", LONG_MS) as talk:
        seen = talk.next()
        assert (seen["event"], seen["alive"], seen["stale"], seen["value"]) == ("frame", 1, 0, 5)
        kill(process)
        seen = talk.next()
        assert (seen["event"], seen["alive"], seen["stale"], seen["value"]) == ("gone", 0, 1, 5)
        with lone_writer(value=6) as again:
            assert talk.next()["event"] == "restarted"
            seen = talk.until("frame")
            assert (seen["alive"], seen["stale"], seen["value"], seen["count"]) == (1, 0, 6, 30)
            kill(again)
            assert talk.next()["event"] == "gone"
        with lone_writer(n_modules=2, value=7):
            assert talk.next()["event"] == "structure changed"
            seen = talk.until("frame")
            assert (seen["value"], seen["count"]) == (7, 10)
            talk.end_input()
    ServiceWriter("x", {"values": ("u1", 1)}).close()


def test_a_dead_writer_is_told_once_and_then_waited_for(program: Path) -> None:
    with lone_writer() as process, talking(program, "follow", "x", 120) as talk:
        assert talk.next()["event"] == "frame"
        assert talk.next()["event"] == "timeout"
        kill(process)
        talk.until("gone")
        for _ in range(3):
            seen = talk.next()
            assert seen["event"] == "gone"
            assert seen["waited_ns"] >= 120_000_000
        talk.end_input()
    assert run(program, "describe", "x")["stale"] == 1  # a late joiner reads its last frame, too
    ServiceWriter("x", {"values": ("u1", 1)}).close()


def test_a_stopped_process_is_alive_but_silent(program: Path) -> None:
    with lone_writer() as process:
        os.kill(process.pid, signal.SIGSTOP)
        with talking(program, "follow", "x", 120) as talk:
            assert talk.next()["event"] == "frame"
            seen = talk.next()
            assert (seen["event"], seen["alive"], seen["stale"]) == ("timeout", 1, 0)
            talk.end_input()
    ServiceWriter("x", {"values": ("u1", 1)}).close()


@pytest.mark.thorough
def test_pause_resume_restructure_and_close_are_told_at_once(any_program: Path) -> None:
    with ServiceWriter("x", {"values": ("<i4", 3)}) as writer, talking(any_program, "follow", "x", LONG_MS) as talk:

        def publish(value: int) -> None:
            writer.begin()["values"][:] = value
            writer.commit(1)

        publish(1)
        assert talk.next()["event"] == "frame"
        writer.pause()
        seen = talk.next()
        assert (seen["event"], seen["state"], seen["value"]) == ("paused", file_layout.STATE_PAUSED, 1)
        talk.stop()  # so that it sees the end of the pause and the frame at the same moment
        writer.resume()
        publish(2)
        talk.process.send_signal(signal.SIGCONT)
        seen = talk.next()
        assert (seen["event"], seen["value"]) == ("frame", 2)
        writer.pause()
        assert talk.next()["event"] == "paused"
        writer.resume()
        writer.restructure({"values": ("<i4", 4)})
        seen = talk.next()
        assert (seen["event"], seen["count"], seen["value"]) == ("structure changed", 4, -1)
        publish(3)
        assert talk.next()["value"] == 3
        for number in (1, 2):  # the columns are the same, but not what a table says
            writer.restructure({"values": ("<i4", 4)}, {"table": np.array([number])})
            assert talk.next()["event"] == "structure changed"
        writer.restructure({"values": ("<i4", 4)}, {"table": np.array([2])})
        assert talk.next()["event"] == "restarted"
        publish(4)
        assert talk.next()["value"] == 4
        assert talk.interrupt()["event"] == "interrupted"
        writer.close()
        seen = talk.next()
        while seen["event"] == "interrupted":
            seen = talk.next()
        assert (seen["event"], seen["state"], seen["stale"], seen["value"]) == ("gone", file_layout.STATE_CLOSED, 1, 4)
        talk.end_input()
