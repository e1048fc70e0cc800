"""Poses followed along episodes, disturbances, moved cameras: what `openspm bench` measures, written down.

    python -m benchmarks.followed perception --env.type=libero

takes the options of `openspm bench` and goes on where it was interrupted, as that does.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import draccus
from benchmarks.common import write

from lerobot_openspm.cli.bench import MEASURES, BenchConfig
from lerobot_openspm.envs.gl_backend import set_default_gl_backend


def main(what: str, options: list[str]) -> dict[str, Any]:
    """Measure, write and return the result."""
    set_default_gl_backend()
    config = draccus.parse(config_class=BenchConfig, args=options)
    result = {"seed": config.seed, **MEASURES[what](config)}
    return write(f"{what}_{config.env.type}" if what == "perception" else what, result)


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], sys.argv[2:])))
