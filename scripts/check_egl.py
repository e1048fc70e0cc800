"""Try to draw one small picture with MuJoCo's EGL backend; one line and exit status 1 where that fails."""

import os
import subprocess
import sys

DRAW = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 16, 16) as renderer:
    renderer.update_scene(data)
    assert renderer.render().shape == (16, 16, 3)
"""


def main() -> int:
    """Return 0 when drawing works or another backend was chosen, 1 otherwise."""
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL", "egl") != "egl":
        return 0
    # In a process of its own: a broken driver may end the process, and the backend is chosen at import.
    run = subprocess.run(
        [sys.executable, "-c", DRAW],
        env={**os.environ, "MUJOCO_GL": "egl"},
        capture_output=True,
        text=True,
        check=False,
    )
    if run.returncode == 0:
        return 0
    reason = (run.stderr.strip().splitlines() or [f"exit status {run.returncode}"])[-1]
    print(
        "MuJoCo cannot draw without a display (EGL): run"
        " `sudo apt-get install -y libegl1 libegl-mesa0 libgl1-mesa-dri libgles2`"
        f" (reason: {reason})",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
