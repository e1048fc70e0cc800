"""`openspm collect`: record scripted demonstrations on the tabletop or on LIBERO as a LeRobotDataset."""

import json

import draccus

from lerobot_openspm.envs.collection import CollectConfig, collect


def main(args: list[str]) -> None:
    """Collect, and print one JSON object last."""
    print(json.dumps(collect(draccus.parse(CollectConfig, args=args))))
