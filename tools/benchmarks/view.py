"""What the server of skin-view costs: processor time per turn, as share of a core and beside a copy of the same bytes.

tools/bench view [--seconds S] [--sensors N ...] [--viewers N ...] [--mode MODE ...] [--profile]

A driver publishes at 100 Hz; viewers pull at 25 Hz, as a page does that draws so often.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

from processes import Processes, answer, own_namespace
from record import LARGE, cpu_s, driving
from websockets.asyncio.client import ClientConnection, connect

MIDDLE = 5_376
FPS = 25
MODES = ("raw", "change", "peak", "wipe")
_COPIES = 2_000


@contextmanager
def serving(namespace: str, profile: Path | None) -> Iterator[tuple[int, str]]:
    """skin-view as people start it; its process id and its address."""
    arguments = ["--namespace", namespace, "--port", "0", "--no-browser", "--json"]
    program = [str(Path(sys.executable).parent / "skin-view")]
    if profile is not None:
        program = [sys.executable, "-m", "cProfile", "-o", str(profile), *program]
    process = subprocess.Popen([*program, *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.pid, json.loads(process.stdout.readline())["url"]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()
        process.stdout.close()


def view(pipe: Connection, url: str, mode: str) -> None:
    """Pull turns until the other end says enough; then how many pictures and bytes."""
    asyncio.run(_view(pipe, url, mode))


async def _view(pipe: Connection, url: str, mode: str) -> None:
    async with connect(url.replace("http", "ws", 1) + "live", compression=None, max_size=None) as socket:
        await socket.send(json.dumps({"op": "look", "mode": mode, "fps": FPS}))
        await _pull(socket)
        for _ in range(FPS):  # what is sent once, and baselines
            await _pull(socket)
        pipe.send("ready")
        pictures = size = 0
        while not pipe.poll():
            data = await _pull(socket)
            size += len(data)
            pictures += b'"pictures"' in data[:2000]
        pipe.send((pictures, size))


async def _pull(socket: ClientConnection) -> bytes:
    await socket.send('{"op":"next"}')
    data = await socket.recv()
    assert isinstance(data, bytes)
    return data


def copy_s(size: int) -> float:
    """Processor time to copy so many bytes."""
    data = bytearray(size)
    begin_s = time.process_time()
    for _ in range(_COPIES):
        bytes(data)
    return (time.process_time() - begin_s) / _COPIES


def cost(sensors: int, viewers: int, mode: str, seconds: float, profile: Path | None) -> None:
    with own_namespace() as namespace, driving(namespace.name, sensors, "analogue"):
        with serving(namespace.name, profile) as (pid, url), Processes() as processes:
            pipes = [processes.start(view, url, mode) for _ in range(viewers)]
            for pipe in pipes:
                answer(pipe, 60)
            begin_s, used_s = time.monotonic(), cpu_s(pid)
            time.sleep(seconds)
            passed_s, used_s = time.monotonic() - begin_s, cpu_s(pid) - used_s
            for pipe in pipes:
                pipe.send("enough")
            found = [answer(pipe, 60) for pipe in pipes]
    pictures, size = sum(count for count, _ in found), sum(size for _, size in found)
    turn_s = used_s / max(pictures, 1)
    print(
        f"  {sensors:6} taxels  {viewers} viewers  {mode:<6}  {pictures / viewers / passed_s:5.1f} pictures/s each"
        f"  {1e3 * turn_s:6.2f} ms a turn  {100 * used_s / passed_s:5.1f} % of a core"
        f"  {turn_s / copy_s(size // max(pictures, 1)):6.0f} times a copy"
        f" of its {size / max(pictures, 1) / 1e3:.1f} kB",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--sensors", type=int, nargs="+", default=[MIDDLE, LARGE], metavar="N")
    parser.add_argument("--viewers", type=int, nargs="+", default=[1, 2], metavar="N")
    parser.add_argument("--mode", nargs="+", choices=MODES, default=list(MODES))
    parser.add_argument("--profile", type=Path, metavar="FILE", help="write the last run's profile there (cProfile)")
    options = parser.parse_args()
    print(f"driver at 100 Hz, {FPS} pictures/s wanted, {options.seconds:g} s each; load {os.getloadavg()[0]:.1f}")
    for sensors in options.sensors:
        for viewers in options.viewers:
            for mode in options.mode:
                cost(sensors, viewers, mode, options.seconds, options.profile)


if __name__ == "__main__":
    main()
