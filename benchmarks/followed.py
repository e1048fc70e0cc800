"""What `openspm bench` measures, written down beside the commit and the machine.

    python -m benchmarks.followed perception --env.type=libero

takes the options of `openspm bench` and goes on where it was interrupted, as that does.
"""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import draccus
from benchmarks.common import write

from lerobot_openspm.cli.bench import MEASURES, ON_THEIR_OWN, BenchConfig
from lerobot_openspm.envs.gl_backend import set_default_gl_backend

# Measured in one simulator at a time, so each has a file of its own.
BY_SIMULATOR = ("perception", "keyposes")


def main(what: str, options: list[str]) -> dict[str, Any]:
    """Measure, write and return the result."""
    set_default_gl_backend()
    if what in MEASURES:
        config, measure = draccus.parse(config_class=BenchConfig, args=options), MEASURES[what]
    else:
        module = importlib.import_module(ON_THEIR_OWN[what])
        config, measure = draccus.parse(config_class=module.Options, args=options), module.measure
    seed = {"seed": config.seed} if hasattr(config, "seed") else {}
    name = f"{what}_{config.env.type}" if what in BY_SIMULATOR else what
    return write(name, {**seed, **measure(config)})


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], sys.argv[2:])))
