"""Physics under emulated devices: a MuJoCo scene presses their taxels. Needs the extra ``mujoco``."""
