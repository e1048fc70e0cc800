"""Objects of the drawn world, learned once for every test that only needs some."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from tests.perception.drawn_world import demonstration

from lerobot_openspm.perception.objects import store
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.shape.model import ShapeModel


def learn(folder: Path) -> None:
    """Learn block and cup from eight scenes, in one of which the hand touched something else."""
    rng = np.random.default_rng(1)
    scenes = [demonstration(rng, wrong=i == 3) for i in range(8)]
    folder.mkdir()
    for name, model in learn_objects(scenes, np.random.default_rng(0)).models.items():
        fields, arrays = store.to_parts(model)
        (folder / f"{name}.json").write_text(json.dumps(fields))
        save_file({key: np.ascontiguousarray(array) for key, array in arrays.items()}, folder / f"{name}.st")


@pytest.fixture(scope="session")
def drawn_objects(make_once: Callable[..., Path]) -> dict[str, ShapeModel]:
    """Models of the drawn world's block and cup, learned from cues alone."""
    folder = make_once("drawn_objects", learn)
    read = {
        file.stem: store.from_parts(
            json.loads(file.read_text()), load_file(file.with_suffix(".st")), str(file)
        )
        for file in sorted(folder.glob("*.json"))
    }
    return {name: model for name, model in read.items() if isinstance(model, ShapeModel)}
