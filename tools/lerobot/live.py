"""Records an emulated hand with lerobot-record, and compares every row with the recorded frame nearest to its time.

The time of a row is that of the robot, which logs when it was asked. Where the process was held up between the plugin's
look at the clock and the robot's, the row's own age says the plugin's.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path

import numpy as np
import numpy.typing as npt
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import skinware
import skinware.recording
from skinware.learning.features import Totals, state_name
from skinware.learning.images import Colours, TouchImage, range_of

BIN = Path(sys.executable).parent
Numbers = npt.NDArray[np.int64]
FPS, SECONDS, EPISODES, TIE_NS, LONGEST_NS = 30, 4, 3, 300_000, 2_000_000_000
"""Two frames that are as near but for TIE_NS are both right: plugin and robot read the clock at two moments."""


def main() -> None:
    folder = Path(sys.argv[1])
    os.environ["SKINWARE_NAMESPACE"] = f"lerobot-{os.getpid()}"
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)
    print(f"lerobot {version('lerobot')}, live")
    for name, busy in (("quiet", 0), ("busy", 8)):
        check_rows(folder, name, busy)
    check_videos(folder)
    check_death(folder)
    check_policy(folder)


def start_hand() -> subprocess.Popen[bytes]:
    """Start an emulated hand, with real-time scheduling where this user may, as the page on busy machines says."""
    realtime = ["--realtime", "fifo:50"] if os.geteuid() == 0 else []
    hand = subprocess.Popen(
        [BIN / "skin-driver", "--driver", "inspire", "--bus", "virtual", "--name", "hand", *realtime],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    with skinware.DriverReader("hand", timeout_s=60) as reader:
        while not reader.read(timeout_s=60).fresh("pressure").all():
            time.sleep(0.05)
    return hand


def end(process: subprocess.Popen[bytes], how: signal.Signals = signal.SIGINT) -> None:
    process.send_signal(how)
    process.wait(30)


def record(
    folder: Path, name: str, *, episodes: int = EPISODES, video: bool = False, stale: str = "raise", age_ms: int = 300
) -> list[str]:
    """The words of lerobot-record for a robot with touch."""
    camera = f"{{type: skinware, driver: hand, height: 48, width: 96, max_age_ms: {age_ms}, when_stale: {stale}}}"
    touch = [
        "--robot.type=skinware",
        f"--robot.robot={{type: stand_in, log: {folder / name}.times}}",
        "--robot.driver=hand",
        "--robot.numbers=taxel",
        f"--robot.when_stale={stale}",
        f"--robot.max_age_ms={age_ms}",
        f"--robot.cameras={{touch: {camera}}}",
    ]
    return record_robot(folder, name, touch, episodes=episodes, video=video)


def record_robot(
    folder: Path, name: str, robot: list[str], *, episodes: int = EPISODES, video: bool = False
) -> list[str]:
    """The words of lerobot-record for a robot."""
    return [
        str(BIN / "lerobot-record"),
        "--robot.discover_packages_path=stand_in",
        *robot,
        "--teleop.type=stand_in",
        f"--dataset.repo_id=skinware/{name}",
        f"--dataset.root={folder / name}",
        "--dataset.no_stamp=true",
        f"--dataset.num_episodes={episodes}",
        f"--dataset.episode_time_s={SECONDS}",
        "--dataset.reset_time_s=0",
        "--dataset.single_task=touch",
        f"--dataset.video={str(video).lower()}",
        "--dataset.push_to_hub=false",
        f"--dataset.fps={FPS}",
        "--play_sounds=false",
    ]


def check_rows(folder: Path, name: str, busy: int) -> None:
    with ExitStack() as stack:
        stack.callback(end, start_hand())
        for _ in range(busy):
            stack.callback(end, subprocess.Popen([sys.executable, "-c", "while True: pass"]), signal.SIGKILL)
        alone = f"{name}-alone"
        times = folder / f"{alone}.times"
        run(record_robot(folder, alone, ["--robot.type=stand_in", f"--robot.log={times}"]))
        without_hz = rate_hz(LeRobotDataset(f"skinware/{alone}", root=folder / alone), np.loadtxt(times, np.int64))
        tape = folder / f"{name}.mcap"
        recorder = subprocess.Popen(
            [BIN / "skin-record", "-o", tape], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        done = subprocess.run(record(folder, name, age_ms=10_000), capture_output=True, text=True)
        end(recorder)
        assert done.returncode == 0, done.stderr[-3000:]
    dataset = LeRobotDataset(f"skinware/{name}", root=folder / name)
    assert dataset.meta.total_episodes == EPISODES
    state = np.stack([np.asarray(each) for each in dataset.hf_dataset["observation.state"]])
    names = dataset.meta.features["observation.state"]["names"]
    with skinware.recording.open(tape) as recording:
        series = recording["hand"].read()
        layout = next(iter(recording.snapshots())).layout
    positions = np.arange(len(layout.module_of("pressure")))
    totals = Totals(layout, "pressure", positions, "taxel")
    columns = [names.index(state_name(each)) for each in totals.names]
    values = np.where(series.status_of("pressure") == 0, series.physical("pressure"), 0)
    times_ns = np.loadtxt(f"{folder / name}.times", np.int64)
    assert len(times_ns) == len(state) == dataset.meta.total_frames, (len(times_ns), len(state))
    acquired_ns = series.acquired_ns
    period_ns = series.origin.period_ns
    image = TouchImage(layout, "pressure", positions, 48, 96, Colours("grey", *range_of(layout, "pressure")))
    of_all, late, held_up, offs = 0, 0, 0, []
    age_ns = np.rint(state[:, names.index(state_name("age_s"))].astype(np.float64) * 1e9).astype(np.int64)
    for row, time_ns in enumerate(times_ns.tolist()):
        equal = np.flatnonzero((values.astype(np.float32) == state[row, columns]).all(axis=1))
        assert len(equal), f"{name}, row {row}: no frame has these values"
        before_ns = time_ns - (acquired_ns[equal] + age_ns[row])  # if it was this frame
        possible = np.flatnonzero((before_ns > -TIE_NS) & (before_ns < LONGEST_NS))
        assert len(possible), f"{name}, row {row}: its age is {before_ns / 1e6} ms off"
        found: list[int] = []
        for number in sorted(possible.tolist(), key=lambda number: abs(before_ns[number])):
            asked_ns = time_ns - int(before_ns[number])
            nearest = nearest_so_far(acquired_ns, series.published_ns, asked_ns)
            if equal[number] in nearest:
                found, time_ns = [int(equal[number])], asked_ns
                held_up += before_ns[number] > TIE_NS
                break
        assert found, f"{name}, row {row}: not the frame nearest to its time: {before_ns[possible] / 1e6} ms"
        frame, distance = found[-1], np.abs(acquired_ns - time_ns)
        of_all += distance[frame] <= distance.min() + TIE_NS
        if distance[frame] > period_ns / 2 + TIE_NS:  # a nearer one, if there was any, was later than it was waited for
            late += 1
            nearer = [each for each in nearest if distance[each] < distance[frame] - TIE_NS]
            assert all(series.published_ns[each] > time_ns + period_ns for each in nearer), (
                f"{name}, row {row}: too soon"
            )
        picture = np.asarray(dataset[row]["observation.images.touch"])
        picture = np.rint(picture * 255).astype(np.uint8).transpose(1, 2, 0)
        assert any(np.array_equal(picture, image.of(values[each])) for each in nearest), f"{name}, row {row}: its image"
        offs.append(distance[frame] / 1e6)
    within = float(np.mean(np.array(offs) <= period_ns / 2e6))
    print(
        f"{name}: {len(state)} rows in {EPISODES} episodes, {rate_hz(dataset, times_ns):.1f} a second"
        f" ({without_hz:.1f} without touch), each the frame nearest to its time of those in the ring"
        f" ({of_all / len(state):.0%} of those that came later, too): median {np.median(offs):.2f}, largest"
        f" {max(offs):.2f} ms away; {within:.1%} within half a period ({period_ns / 2e6:.1f} ms), {late} of a late"
        f" driver; {held_up} held up between the two clocks"
    )


def rate_hz(dataset: LeRobotDataset, times_ns: Numbers) -> float:
    """Return the rows a second within the episodes."""
    spans_ns = [np.ptp(times_ns[rows_of(dataset, number)]) for number in range(EPISODES)]
    return float((len(times_ns) - EPISODES) / (np.sum(spans_ns) / 1e9))


def nearest_so_far(acquired_ns: Numbers, published_ns: Numbers, time_ns: int) -> list[int]:
    """The frame nearest to a time of those published by then, then each that was nearer when it was published."""
    distance = np.abs(acquired_ns - time_ns)
    before = np.flatnonzero(published_ns <= time_ns + TIE_NS)
    found = [int(before[np.argmin(distance[before])])]
    for frame in range(int(before[-1]) + 1, len(distance)):
        if distance[frame] < distance[found[-1]] + TIE_NS:
            found.append(frame)
    return found


def rows_of(dataset: LeRobotDataset, number: int) -> slice:
    episode = dataset.meta.episodes[number]
    return slice(episode["dataset_from_index"], episode["dataset_to_index"])


def check_videos(folder: Path) -> None:
    hand = start_hand()
    done = subprocess.run(
        record(folder, "video", episodes=1, video=True, age_ms=10_000), capture_output=True, text=True
    )
    end(hand)
    assert done.returncode == 0, done.stderr[-3000:]
    dataset = LeRobotDataset("skinware/video", root=folder / "video")
    assert dataset.meta.features["observation.images.touch"]["dtype"] == "video"
    assert dataset[5]["observation.images.touch"].shape == (3, 48, 96)
    print(f"video: {len(dataset)} rows, read back")


def check_death(folder: Path) -> None:
    """A killed driver ends lerobot-record with its error; with hold, a flag is set until the driver returns."""
    for stale in ("raise", "hold"):
        hand = start_hand()
        name = f"death-{stale}"
        recorder = subprocess.Popen(record(folder, name, episodes=2, stale=stale), stderr=subprocess.PIPE, text=True)
        times = Path(f"{folder / name}.times")
        while not times.exists() or times.read_text().count("\n") < 30:
            assert recorder.poll() is None
            time.sleep(0.05)
        end(hand, signal.SIGKILL)
        if stale == "hold":
            time.sleep(1)
            hand = start_hand()
        _, errors = recorder.communicate(timeout=120)
        if stale == "raise":
            assert recorder.returncode != 0
            assert "TimeoutError" in errors.splitlines()[-1], errors[-2000:]
            print(f"killed: {errors.splitlines()[-1]}")
            with skinware.Skin() as skin:
                assert skin.latest() is None
            continue
        end(hand)
        assert recorder.returncode == 0, errors[-3000:]
        dataset = LeRobotDataset(f"skinware/{name}", root=folder / name)
        held = dataset.meta.features["observation.state"]["names"].index(state_name("held"))
        flags = np.array([float(each[held]) for each in dataset.hf_dataset["observation.state"]])
        assert 0 < flags.sum() < len(flags)
        assert flags[0] == flags[-1] == 0
        print(f"held: {int(flags.sum())} of {len(flags)} rows while the driver was gone; then it went on")


def check_policy(folder: Path) -> None:
    """A stock policy learns a few steps from the rows and images of touch, and moves the robot."""
    trained = folder / "trained"
    small = ("dim_model=32", "dim_feedforward=32", "n_heads=2", "n_encoder_layers=1", "latent_dim=4", "chunk_size=10")
    train = [
        str(BIN / "lerobot-train"),
        "--dataset.repo_id=skinware/quiet",
        f"--dataset.root={folder / 'quiet'}",
        f"--output_dir={trained}",
        "--policy.type=act",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null",
        "--policy.n_action_steps=10",
        *(f"--policy.{option}" for option in small),
        "--steps=3",
        "--batch_size=4",
        "--num_workers=0",
        "--log_freq=1",
        "--env_eval_freq=0",
        "--wandb.enable=false",
    ]
    run(train)
    hand = start_hand()
    moved = f"{folder / 'rollout'}.times"
    robot = [each for each in record(folder, "rollout", age_ms=10_000) if each.startswith("--robot")]
    policy = trained / "checkpoints" / "last" / "pretrained_model"
    run(
        [
            str(BIN / "lerobot-rollout"),
            "--strategy.type=base",
            f"--policy.path={policy}",
            *robot,
            "--task=touch",
            "--duration=3",
        ]
    )
    end(hand)
    turns = Path(moved).read_text().count("\n")
    assert turns > 1, turns
    print(f"policy: trained with lerobot-train, then moved the robot for {turns} turns with lerobot-rollout")


def run(words: list[str]) -> None:
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, f"{words[0]}: {done.stdout[-1000:]} {done.stderr[-3000:]}"


if __name__ == "__main__":
    main()
