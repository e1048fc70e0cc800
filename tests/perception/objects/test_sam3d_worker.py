"""The real worker's script with a made-up SAM 3D in its place."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.perception.objects import sam3d_scene as scene

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.objects.base import Appearance
from lerobot_openspm.perception.objects.sam3d import worker as sam3d_worker
from lerobot_openspm.perception.objects.sam3d.size import Sam3dShape, request_arrays, worker_command

# What the worker uses of SAM 3D, by the names and shapes of its source.
MADE_UP = """
import os
import numpy as np
import torch

print("Loading model weights...")
ANSWER = dict(np.load(os.path.join(os.path.dirname(__file__), "answer.npz")))


class Gaussian:
    def __init__(self, points):
        stray = torch.tensor([[9.0, 9.0, 9.0]])
        faint = torch.full((50, 3), 5.0)
        self.get_xyz = torch.cat([torch.from_numpy(points).float(), stray, faint])
        self.get_opacity = torch.cat([torch.full((len(points) + 1, 1), 0.99), torch.full((50, 1), 0.2)])


class Inference:
    def __init__(self, config_file, compile=False):
        assert os.path.basename(config_file) == "pipeline.yaml" and os.path.isfile(config_file)
        self.cuda_home = os.environ["CONDA_PREFIX"]

    def __call__(self, image, mask, seed=None, pointmap=None):
        print("Sampling sparse structure", image.shape)
        assert image.dtype == np.uint8 and image.ndim == 3 and mask.dtype == bool
        rgba = np.concatenate([image[..., :3], (mask.astype(np.uint8) * 255)[..., None]], axis=-1)
        if not rgba[..., 3].any():
            raise ValueError("empty mask")
        assert torch.is_tensor(pointmap) and pointmap.shape == image.shape
        np.savez(
            os.path.join(os.path.dirname(__file__), "request.npz"),
            rgba=rgba, seed=seed, pointmap=pointmap.numpy(), cuda_home=self.cuda_home,
        )
        whole = torch.from_numpy
        points = ANSWER["points"][:4] if (image == 4).all() else ANSWER["points"]
        return {
            "rotation": whole(ANSWER["rotation_wxyz"]).half()[None],
            "translation": whole(ANSWER["translation"])[None].requires_grad_(),
            "scale": whole(ANSWER["scale"])[None],
            "gaussian": [Gaussian(points)],
        }
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sam-3d-objects")
    (folder / "notebook").mkdir()
    (folder / "checkpoints" / "hf").mkdir(parents=True)
    (folder / "checkpoints" / "hf" / "pipeline.yaml").touch()
    (folder / "notebook" / "inference.py").write_text(MADE_UP)
    answer = scene.described(scene.seen()[0].T_world_cam)
    np.savez(folder / "notebook" / "answer.npz", **answer)
    return folder


@pytest.fixture(scope="module")
def shapes(checkout):
    return Sam3dShape(worker_command(Path(sys.executable), checkout))


def test_the_real_worker_asks_sam3d_and_passes_on_what_it_says(shapes, checkout):
    view, segmentation = scene.seen()
    (shape,) = shapes.describe([Appearance(view, segmentation)])
    assert np.linalg.norm(shape.T_world_obj[:3, 3] - scene.T_WORLD_OBJ[:3, 3]) < 0.003
    np.testing.assert_allclose(shape.extents, scene.EXTENTS, rtol=0.03)
    assert shape.quality > 0.9
    sent = request_arrays(view, segmentation)
    with np.load(checkout / "notebook" / "request.npz") as got:
        np.testing.assert_array_equal(got["rgba"][..., :3], view.image)
        np.testing.assert_array_equal(got["rgba"][..., 3] == 255, segmentation.mask)
        np.testing.assert_array_equal(got["pointmap"], sent["pointmap"])
        assert got["seed"] == sam3d_worker.SEED
        assert got["cuda_home"] == sys.prefix


def test_what_sam3d_raises_is_the_answer_for_that_object_only(checkout, tmp_path):
    plain = request_arrays(*scene.seen())
    questions = (plain, {**plain, "mask": 0 * plain["mask"]}, {**plain, "image": 0 * plain["image"] + 4})
    np.savez(
        tmp_path / "asked.npz",
        **{f"{i}.{key}": a for i, one in enumerate(questions) for key, a in one.items()},
    )
    command = worker_command(Path(sys.executable), checkout)
    files = (str(tmp_path / "asked.npz"), str(tmp_path / "answered.npz"))
    done = subprocess.run((*command, *files), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "Traceback" in done.stderr
    with np.load(files[1]) as answers:
        assert set(answers) == {f"0.{name}" for name in scene.described(np.eye(4))} | {"1.error", "2.error"}
        assert str(answers["1.error"]) == "ValueError: empty mask"
        assert "5 opaque points, expected at least 8" in str(answers["2.error"])


def test_a_checkout_or_a_checkpoint_at_another_place(tmp_path, checkout):
    for folder, what in ((tmp_path, None), (checkout, tmp_path)):
        with pytest.raises(PerceptionError, match=r"no such file, so this is no .* see docs/sam3d\.md"):
            Sam3dShape(worker_command(Path(sys.executable), folder, what)).describe(
                [Appearance(*scene.seen())]
            )


def test_check_loads_the_model_and_stops(checkout):
    command = (*worker_command(Path(sys.executable), checkout, checkout / "checkpoints" / "hf"), "--check")
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stderr
    assert "SAM 3D Objects is loaded" in done.stdout


def test_the_script_needs_only_the_standard_library_numpy_and_python_3_11():
    source = Path(sam3d_worker.__file__).read_text(encoding="utf-8")
    tree = ast.parse(source, feature_version=(3, 11))
    names = [alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in tree.body if isinstance(node, ast.ImportFrom)]
    outside = {name.split(".")[0] for name in names} - set(sys.stdlib_module_names)
    assert outside == {"numpy"}
