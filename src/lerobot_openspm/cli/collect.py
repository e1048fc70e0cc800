"""`openspm collect`: record scripted demonstrations on the tabletop or on LIBERO as a LeRobotDataset."""

import json
from collections.abc import Sequence

import draccus

from lerobot_openspm.envs.collection import CollectConfig, collect


def main(args: Sequence[str] | None = None) -> None:
    """Parse the arguments (default: the command line's), collect, print one JSON object last."""
    config = draccus.parse(config_class=CollectConfig, args=None if args is None else list(args))
    print(json.dumps(collect(config)))
