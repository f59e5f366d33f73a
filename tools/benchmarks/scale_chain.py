"""One skin through all there is, from its structure to a recording that is read again: what each step takes."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bridge import read_all
from light import SERVICE, LightSkin, drive
from links import BIN, LOOPBACK, PATIENCE_S, Command, descriptors, free_ports, memory_mb
from processes import Processes, RunFailed, answer, own_namespace, within
from record import structure_of

import skinware
import skinware.recording
from skinware import DriverReader
from skinware.errors import SkinwareError
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns

TIMES = 20
LIMIT_S = 300.0


class Figure(NamedTuple):
    """What a step took."""

    step: str
    value: float
    unit: str


def tell(sensors: int, hz: float, seconds: float, as_json: bool) -> bool:
    """Measure and tell all steps; whether all went well."""
    if not as_json:
        print(f"chain: {sensors:,} sensors at {hz:g} Hz, load {os.getloadavg()[0]:.1f}\n| step | |\n|---|---|")
    try:
        with within(LIMIT_S):
            for figure in _steps(sensors, hz, seconds):
                told = {"table": "chain", "sensors": sensors, **figure._asdict()}
                text = f"| {figure.step} | {figure.value:.4g} {figure.unit} |"
                print(json.dumps(told) if as_json else text, flush=True)
    except (RunFailed, OSError, SkinwareError) as error:
        failed = {"table": "chain", "sensors": sensors, "failed": str(error)}
        print(json.dumps(failed) if as_json else f"| failed | {error} |")
        return False
    return True


def _steps(sensors: int, hz: float, seconds: float) -> Iterator[Figure]:
    with ExitStack() as stack:
        there, here = (stack.enter_context(own_namespace(role)) for role in ("there", "here"))
        yield from _writing(sensors, hz, there)
        processes = stack.enter_context(Processes())
        driver = processes.start(drive, there.name, sensors, hz)
        answer(driver, PATIENCE_S)
        yield from _reading(there)
        yield from _commands(there)
        yield from _recording(there, seconds)
        yield from _bridge(there, here, processes, seconds)
        driver.send("enough")


def _writing(sensors: int, hz: float, namespace: Namespace) -> Iterator[Figure]:
    begin_s = time.perf_counter()
    structure = structure_of(sensors)
    yield Figure("its structure is made", time.perf_counter() - begin_s, "s")
    tables = sum(table.nbytes for table in structure.to_columns().values())
    yield Figure("tables of the structure, a sensor", tables / sensors, "bytes")
    begin_s = time.perf_counter()
    with LightSkin(namespace, sensors, hz) as skin:
        yield Figure("its driver is started", time.perf_counter() - begin_s, "s")
        with DriverReader(SERVICE, namespace=namespace) as reader:
            yield Figure("a slot of the ring, a sensor", len(reader.read().slot) / sensors, "bytes")
        yield Figure("slots", skin.writer.slots, "")
        yield Figure("its file in /dev/shm", (namespace.path / f"{SERVICE}.ring").stat().st_size / 1e6, "MB")
        yield Figure("a frame is made and published", 1e3 * _median_s(skin.publish), "ms")


def _reading(namespace: Namespace) -> Iterator[Figure]:
    memory = memory_mb(os.getpid())
    begin_s = time.perf_counter()
    with DriverReader(SERVICE, namespace=namespace, timeout_s=PATIENCE_S) as reader:
        reader.read()
        yield Figure("a reader is attached and has a frame", time.perf_counter() - begin_s, "s")
        yield Figure("memory of a reader with one frame", memory_mb(os.getpid()) - memory, "MB")
        yield Figure("a frame is copied", 1e3 * _median_s(reader.read), "ms")
        ages = []
        for frame in reader.samples():
            ages.append(now_ns() - frame.acquired_ns)
            if len(ages) == TIMES:
                break
        yield Figure("age of a frame at its reader", float(np.median(ages)) / 1e6, "ms")
    begin_s = time.perf_counter()
    with skinware.Skin(namespace=namespace) as skin:
        snapshot = skin.read()
        yield Figure("a Skin is there and has a snapshot", time.perf_counter() - begin_s, "s")
        yield Figure("physical values of it", 1e3 * _median_s(lambda: snapshot.physical("pressure")), "ms")
        yield Figure("what is fresh of it", 1e3 * _median_s(lambda: snapshot.fresh("pressure")), "ms")


def _commands(namespace: Namespace) -> Iterator[Figure]:
    for command in (["skin-info", "--json"], ["skin-info"], ["skin-dump", "-n", "1", "--json"]):
        begin_s = time.perf_counter()
        done = subprocess.run(
            [BIN / command[0], *command[1:], "--namespace", namespace.name],
            capture_output=True,
            check=False,
            timeout=PATIENCE_S,
        )
        if done.returncode:
            raise RunFailed(f"{' '.join(command)}: {done.stderr.decode()}")
        yield Figure(f"{' '.join(command)}, with its start", time.perf_counter() - begin_s, "s")
        yield Figure(f"{' '.join(command)} prints", len(done.stdout) / 1e3, "kB")


def _recording(namespace: Namespace, seconds: float) -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "skin.mcap"
        options = ["-o", str(file), "--namespace", namespace.name, "-T", str(seconds), "--json"]
        done = subprocess.run(
            [BIN / "skin-record", *options], capture_output=True, text=True, check=False, timeout=seconds + PATIENCE_S
        )
        if done.returncode:
            raise RunFailed(f"skin-record: {done.stderr}")
        told = json.loads(done.stdout.splitlines()[-1])
        frames = told["messages"][f"/skin/{SERVICE}/frame"]
        yield Figure("recorded", frames / seconds, "frames/s")
        yield Figure("lost by the recorder", told["missed"], "frames")
        yield Figure("a recorded frame", told["bytes"] / frames / 1e3, "kB")
        begin_s = time.perf_counter()
        with skinware.recording.open(file) as recording:
            read = len(recording[SERVICE].read(["values"]))
        if read != frames:
            raise RunFailed(f"{frames} frames were recorded, {read} are read")
        yield Figure("a recorded frame is read", 1e3 * (time.perf_counter() - begin_s) / frames, "ms")


def _bridge(there: Namespace, here: Namespace, processes: Processes, seconds: float) -> Iterator[Figure]:
    endpoint = f"tcp/{LOOPBACK}:{free_ports(1)[0]}"
    with (
        Command("serve", "--robot", "bench", "--namespace", there.name, "--listen", endpoint) as serving,
        Command("join", "bench", "--connect", endpoint, "--into", here.name) as joining,
    ):
        begin_s = time.perf_counter()
        beyond = processes.start(read_all, here.name)
        answer(beyond, LIMIT_S)
        yield Figure("it appears behind a bridge", time.perf_counter() - begin_s, "s")
        beyond.send("go")
        time.sleep(seconds)
        beyond.send("enough")
        frames, lost, ages = answer(beyond, PATIENCE_S)
        yield Figure("frames there", frames / seconds, "frames/s")
        yield Figure("lost there", lost, "frames")
        yield Figure("age there", float(np.median(ages)) / 1e6, "ms")
        for name, command in (("serve", serving), ("join", joining)):
            yield Figure(f"memory of {name}", memory_mb(command.pid), "MB")
            yield Figure(f"open files of {name}", descriptors(command.pid), "")


def _median_s(work: Callable[[], object]) -> float:
    took = []
    for _ in range(TIMES):
        begin_s = time.perf_counter()
        work()
        took.append(time.perf_counter() - begin_s)
    return float(np.median(took))
