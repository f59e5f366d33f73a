"""A moving picture of a simulated hand that grasps: the scene, and beside it skin-view with what the hand feels.

Usage: python tools/pictures/grasp.py FOLDER NAMESPACE CALM RECORDING
(records CALM from before the hand closes into RECORDING, and writes FOLDER/grasp.webp; see tools/picture)
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # without a screen

import mujoco
from PIL import Image
from skin_view import FRAME_MS, moments, save_moving

from skinware.realtime import NS_PER_S
from skinware.recording import Recording
from skinware.service import ServiceReader
from skinware_drivers.virtual.physics.binding import find_binding
from skinware_drivers.virtual.physics.scene import PhysicsScene
from tests.browser.chromium import chromium

PAGE, SCENE = (960, 600), (400, 600)
WIDTH = 1100
"""Width of the moving picture, pixels."""
FRAMES = 37
ROUND_S, BEFORE_S = 16.0, 7.4
"""The hand closes 8 s after the beginning of each round, and opens after 13 s."""
FIRST_S = 1.0
"""The moving picture begins so late in the recording."""


def scene_time_ns(namespace: str) -> int:
    """Wait until a round is so far that the hand closes soon; return when the scene began, CLOCK_REALTIME ns."""
    with ServiceReader[Any]("truth", namespace=namespace, timeout_s=60) as truth:
        for sample in truth:
            scene_s = float(sample.column("scene_s")[0])
            if scene_s > ROUND_S and scene_s % ROUND_S > BEFORE_S - FIRST_S:
                return int(time.time_ns() - sample.age_ns - round(scene_s * NS_PER_S))
    raise AssertionError("the loop has no end")


class Scene:
    """Pictures of the scene of the hand, which goes its way again."""

    def __init__(self) -> None:
        self._scene = PhysicsScene(find_binding("mujoco:hand", "inspire"))
        look = self._scene.model.vis
        look.headlight.ambient[:] = 0.35
        look.global_.offwidth, look.global_.offheight = SCENE
        self._renderer = mujoco.Renderer(self._scene.model, SCENE[1], SCENE[0])
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = 0.0, 0.015, 0.03
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 0.44, 160, -28

    def picture(self, time_s: float) -> Image.Image:
        """Return it at a time of the scene, never before the last."""
        self._scene.step_to(time_s)
        self._renderer.update_scene(self._scene.data, self._camera)
        return Image.fromarray(self._renderer.render())


def main() -> None:
    folder, own, calm, recording = Path(sys.argv[1]), sys.argv[2], sys.argv[3], Path(sys.argv[4])
    began_ns = scene_time_ns(own)
    seconds = FIRST_S + (FRAMES + 1) * FRAME_MS / 1000
    subprocess.run(["skin-record", "--namespace", calm, "-T", f"{seconds:.1f}", "-o", recording], check=True)
    with Recording(recording) as recorded:
        begin_s = -recorded.time_s(began_ns)  # of the recording, in the scene's time
    with chromium() as browser:
        pages = list(moments(browser, recording, "theme=dark", PAGE, 1, FIRST_S, FRAMES))
    scene, images = Scene(), []
    for time_s, page in pages:
        whole = Image.new("RGB", (SCENE[0] + PAGE[0], PAGE[1]))
        whole.paste(scene.picture(begin_s + time_s), (0, 0))
        whole.paste(page, (SCENE[0], 0))
        images.append(whole.resize((WIDTH, WIDTH * whole.height // whole.width), Image.Resampling.LANCZOS))
    save_moving(images, folder / "grasp.webp")


if __name__ == "__main__":
    main()
