"""A worker with made-up answers, honest or not: MODE, folder, questions, answers.

The folder holds `answer.npz`; the worker leaves its process's number and the questions there.
"""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

mode, folder, asked, answered = sys.argv[1], Path(sys.argv[2]), *map(Path, sys.argv[3:5])


def answers():
    """The made-up answer once for every question."""
    with np.load(folder / "answer.npz") as stored, np.load(asked) as questions:
        n = len({key.split(".")[0] for key in questions})
        return {f"{i}.{name}": array for i in range(n) for name, array in stored.items()}


(folder / "pid").write_text(str(os.getpid()))
shutil.copyfile(asked, folder / "request.npz")
if mode == "honest":
    np.savez(answered, **answers())
elif mode == "dies":
    print("CUDA out of memory", file=sys.stderr, flush=True)
    os._exit(7)
elif mode == "hangs":
    time.sleep(60)
elif mode == "hangs with a child":
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    (folder / "child").write_text(str(child.pid))
    time.sleep(60)
elif mode == "writes nothing":
    pass
elif mode == "writes garbage":
    answered.write_bytes(b"Loading weights: 100%|#####|")
elif mode == "breaks off":
    np.savez(answered, **answers())
    answered.write_bytes(answered.read_bytes()[:-100])
elif mode == "pickles":
    np.savez(answered, **{"0.points": np.array([{}], object)})
elif mode == "raises":
    np.savez(answered, **{"0.error": np.array("RuntimeError: no object here")})
else:
    raise SystemExit(f"no mode {mode!r}")
