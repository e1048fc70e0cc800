r"""The other end of `size.py`: runs SAM 3D Objects in that model's own Python environment.

This file is started as a script by the Python (3.11) that SAM 3D Objects is installed in, so it imports
nothing but the standard library, NumPy and SAM 3D itself. It reads one `.npz` file of questions and writes
one of answers, neither with pickled objects. The arrays of object number i are

    questions   `i.image` (H, W, 3) uint8, `i.mask` (H, W) uint8, perhaps `i.pointmap` (H, W, 3) float32
    answers     those of :func:`reconstruct` after `i.`, or `i.error`, a text
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]

MAX_POINTS = 8192
# Where the model's random numbers start, for each object anew.
SEED = 42


def answer(inference: Callable[..., Mapping[str, Any]], asked: Path, answered: Path) -> None:
    """Read questions and write answers. What goes wrong with one object is the answer for that object."""
    with np.load(asked, allow_pickle=False) as stored:
        arrays = dict(stored)
    answers: dict[str, NDArray[Any]] = {}
    for i in sorted({key.split(".")[0] for key in arrays}, key=int):
        question = {key.removeprefix(f"{i}."): a for key, a in arrays.items() if key.startswith(f"{i}.")}
        try:
            answers |= {f"{i}.{key}": array for key, array in reconstruct(inference, question).items()}
        except Exception as error:
            traceback.print_exc()
            answers[f"{i}.error"] = np.array(f"{type(error).__name__}: {error}")
    np.savez(answered, **answers)  # pyright: ignore[reportArgumentType]  (typed as its other options)


def load(checkout: Path, checkpoint: Path) -> Callable[..., Mapping[str, Any]]:
    """Load the model.

    Read in the repository facebookresearch/sam-3d-objects, not run here (the weights are gated):
    README.md and demo.py put the folder `notebook` on the path and call `Inference(config_file,
    compile=False)` with `checkpoints/hf/pipeline.yaml`; notebook/inference.py reads the variable
    CONDA_PREFIX, which is set only in an activated environment.

    Raises:
        FileNotFoundError: The checkout or the checkpoint is not at its place.
    """
    module, config = checkout / "notebook" / "inference.py", checkpoint / "pipeline.yaml"
    for path, what in ((module, "checkout of sam-3d-objects"), (config, "checkpoint of SAM 3D Objects")):
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file, so this is no {what}; see docs/sam3d.md")
    os.environ["CONDA_PREFIX"] = sys.prefix
    sys.path.append(str(module.parent))
    from inference import Inference  # pyright: ignore[reportMissingImports]

    return Inference(str(config), compile=False)


def reconstruct(inference: Callable[..., Mapping[str, Any]], question: Arrays) -> dict[str, NDArray[Any]]:
    """Pose, size and surface of the object in a picture, all as SAM 3D says them.

    Read in the same repository, not run here: `Inference.__call__(image, mask, seed, pointmap)` takes arrays
    `(H, W, 3)` uint8 and `(H, W)`, and the point map as a tensor `(H, W, 3)` in PyTorch3D's camera frame
    (sam3d_objects/pipeline/inference_pipeline_pointmap.py: `compute_pointmap`; points that are not finite
    count as unknown). `rotation` `(1, 4)` is a quaternion w, x, y, z, `translation` and `scale` are `(1, 3)`,
    and `make_scene` of notebook/inference.py takes the Gaussians' `get_xyz` to the camera by them. As
    its `normalized_gaussian` does, only the opaque Gaussians count as surface.

    Args:
        inference: From :func:`load`.
        question: Arrays `image`, `mask` and perhaps `pointmap`.

    Returns:
        `rotation_wxyz` (4,), `translation` (3,) and `scale` (3,) from the object's canonical frame to
        PyTorch3D's camera frame; `centre` (3,), `extents` (3,) of the object's box and `points` (n, 3) of
        its surface in the canonical frame, where z is up.

    Raises:
        ValueError: The model found no surface, or its pose has another shape than expected.
    """
    pointmap = question.get("pointmap")
    if pointmap is not None:
        import torch  # of SAM 3D's environment

        pointmap = torch.from_numpy(np.array(pointmap, np.float32))
    image, mask = np.array(question["image"]), question["mask"] > 0
    output = inference(image, mask, seed=SEED, pointmap=pointmap)
    low, high, points = _surface(output["gaussian"][0])
    return {
        "rotation_wxyz": _numpy(output["rotation"]).reshape(4),
        "translation": _numpy(output["translation"]).reshape(3),
        "scale": _numpy(output["scale"]).reshape(3),
        "centre": (low + high) / 2,
        "extents": high - low,
        "points": points.astype(np.float32),
    }


def _surface(gaussian: Any) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Corners (3,), (3,) of the box around the opaque Gaussians, and at most MAX_POINTS of them (n, 3)."""
    opaque = _numpy(gaussian.get_opacity).reshape(-1) > 0.9
    points = _numpy(gaussian.get_xyz)[opaque]
    if len(points) < 8:
        raise ValueError(f"SAM 3D gave {len(points)} opaque points, expected at least 8")
    # A few stray Gaussians would make the box as large as they are far.
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    chosen = np.unique(np.linspace(0, len(points) - 1, MAX_POINTS).astype(int))
    return low, high, points[chosen]


def _numpy(tensor: Any) -> NDArray[np.float64]:
    return tensor.detach().float().cpu().numpy().astype(np.float64)


def main() -> None:
    """Load SAM 3D Objects and answer questions, or with ``--check`` only load it."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--checkout", type=Path, required=True, help="folder of sam-3d-objects")
    parser.add_argument("--checkpoint", type=Path, help="folder of pipeline.yaml; CHECKOUT/checkpoints/hf")
    parser.add_argument("--check", action="store_true", help="load the model, say so and stop")
    parser.add_argument("files", type=Path, nargs="*", help="questions.npz to read and answers.npz to write")
    options = parser.parse_args()
    if not options.check and len(options.files) != 2:
        parser.error("expected a file of questions and one for the answers, or --check")
    inference = load(options.checkout, options.checkpoint or options.checkout / "checkpoints" / "hf")
    if options.check:
        print("SAM 3D Objects is loaded")
        return
    answer(inference, *options.files)


if __name__ == "__main__":
    main()
