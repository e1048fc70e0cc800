r"""The other end of `sam3d.py`: runs SAM 3D Objects in that model's own Python environment.

This file is started as a script by the Python (3.11) that SAM 3D Objects is installed in, so it imports
nothing but the standard library, NumPy and SAM 3D itself. It also defines the messages of both ends:

    8 bytes    b"OPENSPM\n"
    4 bytes    length of the header, unsigned, little-endian
    header     JSON: version, kind, id, seed, text, arrays (name, dtype and shape of each)
    body       the arrays' bytes one after another: little-endian, last index first, nothing between them

The worker says `ready` when the model is loaded, then answers every `request` by an `answer` or an `error`
with the same id, until its input ends. Everything else that is printed goes to the standard error.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import struct
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]

VERSION = 1
MAGIC = b"OPENSPM\n"
PREFIX = struct.Struct("<8sI")
MAX_HEADER_BYTES = 1 << 16
MAX_BODY_BYTES = 1 << 28
DTYPES = {"uint8": "|u1", "float32": "<f4", "float64": "<f8"}
MAX_POINTS = 8192


class WireError(ValueError):
    """Bytes that are no message of this version."""


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        kind: ``"ready"``, ``"request"``, ``"answer"`` or ``"error"``.
        id: Of a request, and of the answer or error that belongs to it.
        arrays: By name, of the types in :data:`DTYPES`.
        seed: Of a request: where the model's random numbers start.
        text: Of an error: what happened.
    """

    kind: str
    id: int
    arrays: Arrays
    seed: int = 0
    text: str = ""


def pack(message: Message) -> bytes:
    """The bytes of a message. Raises WireError on a type of array that does not travel, or one too large."""
    listed, body = [], []
    for name, array in message.arrays.items():
        if array.dtype.name not in DTYPES:
            raise WireError(f"array {name!r} has dtype {array.dtype}, expected one of {sorted(DTYPES)}")
        listed.append({"name": name, "dtype": array.dtype.name, "shape": list(array.shape)})
        body.append(np.ascontiguousarray(array, DTYPES[array.dtype.name]).tobytes())
    size = sum(map(len, body))
    if size > MAX_BODY_BYTES:
        raise WireError(f"arrays of {size} bytes, expected at most {MAX_BODY_BYTES}")
    fields = {"kind": message.kind, "id": message.id, "seed": message.seed, "text": message.text[:4000]}
    header = json.dumps({"version": VERSION, **fields, "arrays": listed}).encode()
    return b"".join([PREFIX.pack(MAGIC, len(header)), header, *body])


def read_message(read: Callable[[int], bytes]) -> Message | None:
    """Read one message; None where the stream ends before it.

    Args:
        read: Gives so many bytes, and fewer only at the end of the stream.

    Raises:
        WireError: Not a message, one of another version, one too large, or one that breaks off.
    """
    prefix = read(PREFIX.size)
    if not prefix:
        return None
    if len(prefix) < PREFIX.size or not prefix.startswith(MAGIC):
        raise WireError(f"bytes {prefix!r}, expected a message that begins with {MAGIC!r}")
    length = PREFIX.unpack(prefix)[1]
    if length > MAX_HEADER_BYTES:
        raise WireError(f"a header of {length} bytes, expected at most {MAX_HEADER_BYTES}")
    header, listed = _header(_whole(read, length))
    try:
        sizes = [math.prod(shape) * np.dtype(DTYPES[dtype]).itemsize for _, dtype, shape in listed]
        if sum(sizes) > MAX_BODY_BYTES:
            raise WireError(f"arrays of {sum(sizes)} bytes, expected at most {MAX_BODY_BYTES}")
        arrays = {
            name: np.frombuffer(_whole(read, size), DTYPES[dtype]).reshape(shape)
            for (name, dtype, shape), size in zip(listed, sizes, strict=True)
        }
    except KeyError as error:
        raise WireError(f"dtype {error}, expected one of {sorted(DTYPES)}") from error
    return Message(header["kind"], header["id"], arrays, header["seed"], header["text"])


def _header(data: bytes) -> tuple[dict[str, Any], list[tuple[str, str, list[int]]]]:
    """Fields and arrays (name, dtype, shape) of a header; every type is checked, no value is."""
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise WireError(f"a header that is no JSON: {error}") from error
    if not isinstance(header, dict) or header.get("version") != VERSION:
        found = header.get("version") if isinstance(header, dict) else type(header).__name__
        raise WireError(f"version {found!r}, expected {VERSION}")
    for name, kind in {"kind": str, "id": int, "seed": int, "text": str, "arrays": list}.items():
        if type(header.get(name)) is not kind:
            raise WireError(f"header field {name!r} is {header.get(name)!r}, expected {kind.__name__}")
    listed = []
    for entry in header["arrays"]:
        fields = entry if isinstance(entry, dict) else {}
        name, dtype, shape = (fields.get(field) for field in ("name", "dtype", "shape"))
        whole = isinstance(shape, list) and len(shape) <= 8 and all(type(n) is int and n >= 0 for n in shape)
        if not (isinstance(name, str) and isinstance(dtype, str) and whole):
            raise WireError(f"array {entry!r}, expected a name, a dtype and a shape")
        listed.append((name, dtype, cast("list[int]", shape)))
    return header, listed


def _whole(read: Callable[[int], bytes], size: int) -> bytes:
    data = read(size) if size else b""
    if len(data) < size:
        raise WireError(f"a message that breaks off after {len(data)} of {size} bytes")
    return data


def serve(
    read: Callable[[int], bytes], write: Callable[[bytes], object], answer: Callable[[Message], Arrays]
) -> None:
    """Say `ready`, then answer requests until the input ends. What `answer` raises concerns one object."""
    write(pack(Message("ready", 0, {})))
    while (request := read_message(read)) is not None:
        try:
            reply = pack(Message("answer", request.id, answer(request)))
        except Exception as error:
            traceback.print_exc()
            reply = pack(Message("error", request.id, {}, text=f"{type(error).__name__}: {error}"))
        write(reply)


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


def reconstruct(inference: Callable[..., Mapping[str, Any]], request: Message) -> Arrays:
    """Pose, size and surface of the object in a picture, all as SAM 3D says them.

    Read in the same repository, not run here: `Inference.__call__(image, mask, seed, pointmap)` takes arrays
    `(H, W, 3)` uint8 and `(H, W)`, and the point map as a tensor `(H, W, 3)` in PyTorch3D's camera frame
    (sam3d_objects/pipeline/inference_pipeline_pointmap.py: `compute_pointmap`; points that are not finite
    count as unknown). `rotation` `(1, 4)` is a quaternion w, x, y, z, `translation` and `scale` are `(1, 3)`,
    and `make_scene` of notebook/inference.py takes the Gaussians' `get_xyz` to the camera by them. As
    its `normalized_gaussian` does, only the opaque Gaussians count as surface.

    Args:
        inference: From :func:`load`.
        request: With arrays `image`, `mask` and perhaps `pointmap`.

    Returns:
        `rotation_wxyz` (4,), `translation` (3,) and `scale` (3,) from the object's canonical frame to
        PyTorch3D's camera frame; `centre` (3,), `extents` (3,) of the object's box and `points` (n, 3) of
        its surface in the canonical frame, where z is up.

    Raises:
        ValueError: The model found no surface, or its pose has another shape than expected.
    """
    pointmap = request.arrays.get("pointmap")
    if pointmap is not None:
        import torch  # of SAM 3D's environment

        pointmap = torch.from_numpy(np.array(pointmap, np.float32))
    image, mask = np.array(request.arrays["image"]), request.arrays["mask"] > 0
    output = inference(image, mask, seed=request.seed, pointmap=pointmap)
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
    """Load SAM 3D Objects and serve, or with ``--check`` only load it."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--checkout", type=Path, required=True, help="folder of sam-3d-objects")
    parser.add_argument("--checkpoint", type=Path, help="folder of pipeline.yaml; CHECKOUT/checkpoints/hf")
    parser.add_argument("--check", action="store_true", help="load the model, say so and stop")
    options = parser.parse_args()
    # SAM 3D and its libraries print; the pipe is for messages only.
    pipe = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    inference = load(options.checkout, options.checkpoint or options.checkout / "checkpoints" / "hf")
    if options.check:
        print(f"SAM 3D Objects is loaded; messages of version {VERSION}", file=sys.stderr)
        return

    def write(data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[pipe.write(view) :]

    serve(sys.stdin.buffer.read, write, lambda request: reconstruct(inference, request))


if __name__ == "__main__":
    main()
