"""The openpatch driver against openpatch.h on a pseudo terminal, end to end: from C arrays to a user's numpy arrays."""

from __future__ import annotations

import functools
import os
import random
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from skinware import DriverReader, DriverSnapshot, PatchState, Skin, Status
from skinware.errors import RequestFailed
from skinware.realtime import now_ns
from skinware_drivers.testing.waiting import wait_until
from tests.openpatch.microcontroller import HERE, WATCHDOG, Microcontroller, program
from tests.sdk.driving import Driving, driving_lines, read_until

BAD = Status.STALE | Status.NEVER_SEEN


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return program(HERE / "patch.c", "sanitized", tmp_path_factory)


@contextmanager
def driven(*patches: Microcontroller, wait: bool = True, **options: float) -> Iterator[tuple[Driving, DriverReader]]:
    with driving_lines([patch.line(**options) for patch in patches], "openpatch", wait=wait) as running:
        with DriverReader("openpatch", timeout_s=30) as reader:
            yield running, reader


def is_fresh(frame: DriverSnapshot) -> bool:
    return not (frame.status & BAD).any()


def is_live_again(frame: DriverSnapshot, since_ns: int) -> bool:
    return frame.patch_state[0] == PatchState.LIVE and bool((frame.module_time_ns[:4] > since_ns).all())


def restarts(caplog: pytest.LogCaptureFixture) -> int:
    return caplog.text.count("has restarted")


def values_of(module: int, n: int, sample: int) -> npt.NDArray[np.int64]:
    """What the firmware samples, before it is fitted into the dtype."""
    return 5 * module + 3 * np.arange(n) + sample


@pytest.mark.thorough
def test_a_hand_with_all_it_says_of_itself(firmware: Path) -> None:
    with Microcontroller(firmware, "hand", "0042") as patch, driven(patch) as (_, reader):
        frame = read_until(reader, is_fresh)
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"test patch 0042"]
        assert structure.module_kind.tolist() == [b"triangle"] * 3 + [b"palm", b"triangle"] + [b"bones"] * 2
        assert structure.dtype == np.float32
        assert [(t.name, t.id, t.unit, t.scale, t.offset, t.minimum, t.maximum) for t in structure.types] == [
            ("pressure", 1, "kPa", 0.5, -10.0, 0.0, 100.0),
            ("shear_x", 2, "N", 0.01, 0.0, -np.inf, np.inf),
            ("shear_y", 3, "N", 0.01, 0.0, -np.inf, np.inf),
            ("temperature", 5, "degC", 0.1, -20.0, -20.0, 80.0),
            ("strain", 77 << 12 | 9, "µm/m", 1.0, 0.0, -np.inf, np.inf),
        ]
        assert structure.sensor_uid[structure.module_index(1)].tolist() == list(range(11, 22))
        assert structure.sensor_uid[structure.module_index(6)].tolist() == [62, 63]
        temperatures = structure.index("temperature")
        assert structure.sensor_module[temperatures].tolist() == [0, 1, 2, 4]
        status = [set(frame.status[structure.module_index(module)].tolist()) for module in range(7)]
        assert status == [{0}, {0, Status.NO_ACK}, {0}, {Status.OUT_OF_RANGE}, {0}, {0}, {0}]
        assert frame.status[structure.module_index(1)].tolist().index(Status.NO_ACK) == 2
        read_until(reader, lambda f: len(set(samples_of(f))) == 1)


def samples_of(frame: DriverSnapshot) -> list[int]:
    """The sample (modulo 251) that each module of a hand shows; every one must be whole."""
    structure = frame.structure
    kept = [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11]  # channel 6 is padding
    found = []
    for module in range(7):
        values = frame.values[structure.module_index(module)].astype(np.float64)
        if module == 3:
            sample = int(values[0]) + 30000 - 15
            assert values.tolist() == (values_of(3, 16, sample) - 30000).tolist()
        elif module in (5, 6):
            sample = int(4 * values[0]) - 5 * module
            assert values.tolist() == (values_of(module, 4, sample)[::2] / 4).tolist()
        else:
            sample = int(values[0]) - 5 * module
            assert values.tolist() == (values_of(module, 12, sample)[kept] % 251).tolist()
        found.append(sample % 251)
    return found


def test_no_module_is_torn_and_no_sample_lost(firmware: Path) -> None:
    with Microcontroller(firmware, "hand") as patch, driven(patch, rate_hz=100) as (_, reader):
        read_until(reader, is_fresh)
        shown: list[int] = []
        overlooked = -reader.missed
        for count, frame in enumerate(reader.in_order(timeout_s=30)):
            sample = samples_of(frame)[0]
            shown += [sample] if sample not in shown else []
            if count >= 100:
                break
        overlooked += reader.missed  # by this program, if the machine did not let it run
        assert sum((after - before) % 251 - 1 for before, after in pairwise(shown)) <= overlooked
        assert len(shown) > 50
        assert reader.patch_counters(frame)[0]["sequence_lost"] == 0


def test_modules_have_the_time_of_their_sample_over_a_wrap_of_the_clock(firmware: Path) -> None:
    with Microcontroller(firmware, "hand", running=False) as patch:
        patch.run(first_us=2**32 - 300_000)
        with driven(patch) as (_, reader):
            read_until(reader, is_fresh)
            before_ns, seen = np.zeros(7, np.int64), 0
            for count, frame in enumerate(reader.in_order(timeout_s=30)):
                assert (frame.module_time_ns >= before_ns).all()
                assert (frame.module_time_ns <= frame.published_ns).all()
                before_ns = frame.module_time_ns
                if len(set(samples_of(frame))) == 1 and is_fresh(frame):
                    assert len(set(frame.module_time_ns.tolist())) == 1
                    seen += 1
                if count >= 25:
                    break
            assert seen


def test_messages_as_long_as_they_can_be(firmware: Path) -> None:
    with Microcontroller(firmware, "wide") as patch, driven(patch) as (_, reader):
        frame = read_until(reader, is_fresh)
        structure = frame.structure
        assert structure.dtype == np.int32
        deep = frame.values[structure.module_index(1)]
        sample = (int(deep[0]) + 1_000_000_000) // 100_000 - 5
        assert deep.tolist() == (values_of(1, 60, sample) * 100_000 - 1_000_000_000).tolist()
        assert frame.values[structure.module_index(0)].tolist() == (values_of(0, 1016, sample) % 251).tolist()


def test_physical_values_of_taxels_with_axes(firmware: Path) -> None:
    with Microcontroller(firmware, "finger") as patch, driven(patch):
        with Skin() as skin:
            snapshot = skin.read(timeout_s=30)
            assert len(snapshot.physical("shear_x")) == len(snapshot.physical("pressure")) == 4
            difference = np.diff(snapshot.physical("pressure"))
            assert difference.tolist() == [4.5] * 3  # nine counts of 0.5 kPa from taxel to taxel


def test_operations(firmware: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Microcontroller(firmware, "hand") as patch, driven(patch) as (_, reader):
        read_until(reader, is_fresh)
        assert reader.call("rate", hz=90.0) == {"bus0": pytest.approx(1e6 / 11000)}
        with pytest.raises(RequestFailed, match="the patch can do 1 to 1000 Hz"):
            reader.call("rate", hz=0.5)
        reader.call("enable", on=False, module=3)
        frame = read_until(reader, lambda f: bool(f.status[f.structure.module_index(3)][0] & Status.MASKED))
        module = frame.structure.module_index
        read_until(reader, lambda f: bool(f.status[module(3)][0] & Status.STALE) and not f.status[module(0)].any())
        reader.call("enable", module=3)
        read_until(reader, lambda f: f.status[module(3)].tolist() == [Status.OUT_OF_RANGE] * 16)
        with pytest.raises(RequestFailed, match=r"no module 7: the patch has 0 to 6"):
            reader.call("enable", module=7)
        reader.call("tare", module=0)
        read_until(reader, lambda f: not f.values[module(0)].any() and bool(f.values[module(1)].any()))
        with pytest.raises(RequestFailed, match="its hardware failed"):
            reader.call("tare", module=2)
        counts = reader.call("counts")["bus0"]
        assert counts["sent"] > 0
        assert (counts["dropped"], counts["bad_requests"]) == (0, 0)


def test_a_reset_patch_is_set_up_as_before_by_itself(firmware: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Microcontroller(firmware, "hand") as patch, driven(patch) as (running, reader):
        read_until(reader, is_fresh)
        reader.call("rate", hz=200.0)
        reader.call("enable", on=False, module=4)
        read_until(reader, lambda f: bool(f.status[f.structure.module_index(4)][0] & Status.MASKED))
        for _ in range(3):
            known = restarts(caplog)
            patch.kill()  # in the middle of whatever it was doing
            patch.run(WATCHDOG)
            wait_until(lambda known=known: restarts(caplog) > known)  # type: ignore[misc]
            read_until(reader, functools.partial(is_live_again, since_ns=now_ns()))
        module = reader.read().structure.module_index
        read_until(reader, lambda f: bool(f.status[module(4)][0] & Status.MASKED) and not f.status[module(0)].any())
        assert running.status()["patches"][0]["sequence_lost"] == 0
        assert reader.call("counts")["bus0"]["uptime_s"] < 30
    assert "test patch 1 was reset: watchdog, " in caplog.text


def test_other_firmware_on_the_same_port_is_a_new_generation(firmware: Path) -> None:
    with Microcontroller(firmware, "hand") as patch, driven(patch) as (running, reader):
        read_until(reader, is_fresh)
        patch.kill()
        patch.run(model="finger")
        wait_until(
            lambda: (
                running.runner is not None
                and running.runner.builder.generation is not None
                and running.runner.builder.generation.tables.structure.n_modules == 1
            )
        )
        with DriverReader("openpatch") as again:
            frame = read_until(again, is_fresh)
            assert frame.structure.dtype == np.uint16
            assert frame.structure.module_kind.tolist() == [b"fingertip"]


def test_a_patch_that_answers_but_does_not_sample_is_named(firmware: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Microcontroller(firmware, "finger") as patch, driven(patch) as (_, reader):
        read_until(reader, is_fresh)
        patch.signal(signal.SIGUSR1)
        frame = read_until(reader, lambda f: f.patch_state[0] == PatchState.STALE)
        assert (frame.status & Status.STALE).all()
        wait_until(lambda: "its sampling hangs" in caplog.text)
        assert "has restarted" not in caplog.text


def test_what_a_patch_has_to_say(firmware: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Microcontroller(firmware, "finger") as patch, driven(patch) as (_, reader):
        read_until(reader, is_fresh)
        patch.signal(signal.SIGUSR2)
        wait_until(lambda: r"test patch 1 says: supply at 4.1 V\x1b[31m" in caplog.text)


def test_garbage_in_both_directions(firmware: Path) -> None:
    noise = random.Random(5)
    with Microcontroller(firmware, "hand") as patch, driven(patch, rate_hz=200) as (running, reader):
        read_until(reader, is_fresh)
        for count, frame in enumerate(reader.in_order(timeout_s=30)):
            samples_of(frame)
            if count % 3 == 0:
                os.write(patch.master, noise.randbytes(noise.randrange(1, 60)))
                os.write(patch.slave, noise.randbytes(noise.randrange(1, 60)) + b"\0")
            if count >= 200:
                break
        read_until(reader, is_fresh)
        damaged = running.status()["buses"][0]["errors"]
        assert damaged > 20
        for _ in range(5):  # a request that collides with noise is asked again
            counts = reader.call("counts")["bus0"]
        assert counts["bad_requests"] > 20


def test_two_patches_on_two_ports_and_one_that_comes_late(firmware: Path) -> None:
    with Microcontroller(firmware, "finger", "L") as left, Microcontroller(firmware, "finger", "R", False) as right:
        with driving_lines([left.line(), right.line()], "openpatch", wait=False) as running:
            wait_until(lambda: running.runner is not None and bool(running.runner.lines[0].patches))
            right.run()
            wait_until(lambda: len(running.status().get("patches", ())) == 2)
            with DriverReader("openpatch", timeout_s=30) as reader:
                frame = read_until(reader, is_fresh)
                assert frame.structure.patch_name.tolist() == [b"test patch L", b"test patch R"]
                assert frame.structure.sensor_uid.tolist()[13:] == [
                    uid + (1 << 32) for uid in frame.structure.sensor_uid.tolist()[:13]
                ]


def test_a_patch_is_silent_until_it_is_started_and_after_it_was_stopped(firmware: Path) -> None:
    with Microcontroller(firmware, "finger") as patch:
        assert patch.says(30)[1] == 0x60  # its announcement
        with driven(patch) as (_, reader):
            read_until(reader, is_fresh)
        assert patch.says(1.5) == b""
