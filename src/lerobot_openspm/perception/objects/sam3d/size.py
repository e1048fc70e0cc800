"""The shape backend "SAM 3D Objects": the model runs in its own environment, this is the client.

Source: the paper, section "Semantically Conditioned 3D Perception": reconstruction of single objects gives
local shape and principal-axis directions.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Appearance, ObjectShape
from lerobot_openspm.perception.objects.sam3d import worker
from lerobot_openspm.perception.objects.sam3d.reconstruction import (
    FLIP,
    Arrays,
    Reconstruction,
    expect,
    factor_by_points,
    make_upright,
    reconstruction_from,
)
from lerobot_openspm.perception.objects.shape import silhouette
from lerobot_openspm.types import Segmentation, View

# Variables of our own environment that would lead another Python to our packages.
OURS = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV", "CONDA_PREFIX")
LOG_BYTES, LOG_LINES = 8192, 15
LARGEST_M = 10.0
MIN_DEPTH_PIXELS = 16


class Sam3dShape:
    """Shapes by SAM 3D Objects; a :class:`ShapeBackend`.

    All objects are described in one run of the worker, which loads the model, reads one file of questions and
    writes one of answers. The model knows sizes only from depth. Where a view has none, points of the object
    in the world tell its size.

    Args:
        command: The worker's command, from :func:`worker_command`.
        start_timeout_s: Until the worker must have loaded the model ...
        timeout_s: ... and, for each object, until it must have described it.
    """

    def __init__(self, command: Sequence[str], *, start_timeout_s: float = 600.0, timeout_s: float = 120.0):
        self._command = tuple(command)
        self._start_timeout_s, self._timeout_s = start_timeout_s, timeout_s

    def describe(self, objects: Sequence[Appearance]) -> list[ObjectShape]:
        """The objects' upright boxes. Quality is the overlap of shape and mask.

        Raises:
            PerceptionError: The worker cannot be used, its answer makes no sense, or nothing tells a size.
        """
        for one in objects:
            _check(one)
        if not objects:
            return []
        answers = self._ask([request_arrays(one.view, one.segmentation) for one in objects])
        return [_shape(one, arrays) for one, arrays in zip(objects, answers, strict=True)]

    def _ask(self, questions: Sequence[Arrays]) -> list[Arrays]:
        """The worker's answers to arrays, by a run of it that ends by a deadline."""
        limit_s = self._start_timeout_s + self._timeout_s * len(questions)
        with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as log:
            asked, answered = Path(folder) / "questions.npz", Path(folder) / "answers.npz"
            arrays = {f"{i}.{key}": a for i, one in enumerate(questions) for key, a in one.items()}
            np.savez(asked, **arrays)  # pyright: ignore[reportArgumentType]  (typed as its other options)
            code = self._run((*self._command, str(asked), str(answered)), log, limit_s)
            if code != 0:
                got = f"nothing after {limit_s:g} s" if code is None else f"its end with exit code {code}"
                raise self._failed(got, "answers", log)
            try:
                with np.load(answered, allow_pickle=False) as stored:
                    told = dict(stored)
            except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
                raise self._failed(f"no answers that can be read ({error})", "answers", log) from error
            found: list[Arrays] = [
                {key.removeprefix(f"{i}."): a for key, a in told.items() if key.startswith(f"{i}.")}
                for i in range(len(questions))
            ]
            if errors := [str(one["error"]) for one in found if "error" in one]:
                raise self._failed(f"the error {errors[0]!r}", "an answer", log)
            return found

    def _run(self, command: Sequence[str], log: IO[bytes], limit_s: float) -> int | None:
        """Run a command until it ends, or None if it takes too long; what it started ends with it."""
        environment = {name: value for name, value in os.environ.items() if name not in OURS}
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,  # a group of its own, so that what it starts can be ended with it
            )
        except OSError as error:
            raise PerceptionError(
                f"{self._name}: cannot be started: {error}; expected the Python that SAM 3D Objects is "
                "installed in and the worker's script; see docs/sam3d.md"
            ) from error
        try:
            return process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return None
        finally:
            # Where the whole group has ended, there is nothing to kill; macOS says so by a PermissionError.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    @property
    def _name(self) -> str:
        return f"SAM 3D worker ({shlex.join(self._command)})"

    def _failed(self, got: str, expected: str, log: IO[bytes]) -> PerceptionError:
        """What the worker did instead of its task, with the last lines that it printed."""
        log.seek(max(0, log.seek(0, os.SEEK_END) - LOG_BYTES))
        words = "\n".join(log.read().decode(errors="replace").splitlines()[-LOG_LINES:])
        check = shlex.join((*self._command, "--check"))
        return PerceptionError(
            f"{self._name}: got {got}, expected {expected}; try {check!r}, or give it more time. "
            + (f"Its last lines:\n{words}" if words else "It printed nothing.")
        )


def worker_command(python: Path, checkout: Path, checkpoint: Path | None = None) -> tuple[str, ...]:
    """The command of the real worker.

    Args:
        python: The Python of the environment that SAM 3D Objects is installed in.
        checkout: Folder of the sam-3d-objects repository.
        checkpoint: Folder of the weights with `pipeline.yaml`; `checkpoints/hf` of the checkout by default.
    """
    where = () if checkpoint is None else ("--checkpoint", str(checkpoint))
    return (str(python), "-P", worker.__file__, "--checkout", str(checkout), *where)


def request_arrays(view: View, segmentation: Segmentation) -> Arrays:
    """The picture, the mask and, where there is depth, the point map in PyTorch3D's camera frame.

    A mirrored picture (negative ``fx``) is turned back: the model supposes a camera that does not mirror.
    """
    arrays: dict[str, NDArray] = {
        "image": np.asarray(view.image, np.uint8),
        "mask": np.asarray(segmentation.mask, np.uint8),
    }
    if _has_depth(view, segmentation):
        arrays["pointmap"] = (_point_map(view) @ FLIP).astype(np.float32)
    return {name: array[:, ::-1] for name, array in arrays.items()} if view.camera.fx < 0 else arrays


def _shape(one: Appearance, arrays: Arrays) -> ObjectShape:
    found = reconstruction_from(arrays)
    if one.points_world is not None and not _has_depth(one.view, one.segmentation):
        points_cam = se3.apply(se3.inverse(one.view.T_world_cam), one.points_world)
        found = found.scaled(factor_by_points(found, points_cam))
    expect(found.extents.max() < LARGEST_M, "extents", arrays, f"less than {LARGEST_M:g} m, scaled")
    T_world_obj, extents, _ = make_upright(one.view.T_world_cam @ found.T_cam_box, found.extents)
    return ObjectShape(T_world_obj, extents, _quality(found, one.view, one.segmentation))


def _check(one: Appearance) -> None:
    view, segmentation = one.view, one.segmentation
    shape, n_pixels = view.image.shape[:2], np.count_nonzero(segmentation.mask)
    if segmentation.mask.shape != shape or not n_pixels:
        raise PerceptionError(
            f"SAM 3D: got a mask of shape {segmentation.mask.shape} with {n_pixels} pixels, expected shape "
            f"{shape} and at least one pixel; pass the mask of this view"
        )
    if view.depth is not None and view.depth.shape != shape:
        raise PerceptionError(
            f"SAM 3D: got depth of shape {view.depth.shape}, expected {shape}; "
            "pass depth aligned with the image"
        )
    if one.points_world is None and not _has_depth(view, segmentation):
        raise PerceptionError(
            f"SAM 3D needs to know the size: got fewer than {MIN_DEPTH_PIXELS} pixels of the object with "
            "depth and no points of it, expected one of them; give the view's depth or points_world"
        )


def _has_depth(view: View, segmentation: Segmentation) -> bool:
    if view.depth is None:
        return False
    known = np.isfinite(view.depth) & (view.depth > 0) & segmentation.mask
    return np.count_nonzero(known) >= MIN_DEPTH_PIXELS


def _point_map(view: View) -> Array:
    """Points ``(H, W, 3)`` in OpenCV's camera frame, NaN where there is no depth."""
    camera = view.camera
    depth = np.asarray(view.depth, float)
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    v, u = np.indices(z.shape)
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)


def _quality(found: Reconstruction, view: View, segmentation: Segmentation) -> float:
    """Intersection over union of the shape, drawn in the view, and the mask."""
    points = found.points_cam
    spacing = 2 * float(np.median(KDTree(points).query(points, k=2)[0][:, 1]))
    at_camera = replace(view, T_world_cam=np.eye(4))
    drawing = silhouette.draw(points, spacing, np.eye(4), at_camera, detail_px=200.0)
    if drawing is None:
        return 0.0
    mask = np.asarray(segmentation.mask, np.float32)
    common, model, _ = silhouette.overlap(drawing, mask, None)
    return min(1.0, common / (model + np.count_nonzero(segmentation.mask) - common))
