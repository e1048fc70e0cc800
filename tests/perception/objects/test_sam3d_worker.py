"""The messages, and the real worker's script with a made-up SAM 3D in its place."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tests.perception.objects import sam3d_scene as scene

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.objects.sam3d import worker as sam3d_worker
from lerobot_openspm.perception.objects.sam3d.size import Sam3dShape, request_arrays, worker_command
from lerobot_openspm.perception.objects.sam3d.worker import Message, WireError, pack, read_message

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
        points = ANSWER["points"][:4] if seed == 4 else ANSWER["points"]
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
    command = worker_command(Path(sys.executable), checkout)
    with Sam3dShape(command, start_timeout_s=120.0, seed=3) as client:
        yield client


def test_the_real_worker_asks_sam3d_and_passes_on_what_it_says(shapes, checkout):
    view, segmentation = scene.seen()
    shape = shapes.describe(view, segmentation)
    assert np.linalg.norm(shape.T_world_obj[:3, 3] - scene.T_WORLD_OBJ[:3, 3]) < 0.003
    np.testing.assert_allclose(shape.extents, scene.EXTENTS, rtol=0.03)
    assert shape.quality > 0.9
    sent = request_arrays(view, segmentation)
    with np.load(checkout / "notebook" / "request.npz") as got:
        np.testing.assert_array_equal(got["rgba"][..., :3], view.image)
        np.testing.assert_array_equal(got["rgba"][..., 3] == 255, segmentation.mask)
        np.testing.assert_array_equal(got["pointmap"], sent["pointmap"])
        assert got["seed"] == 3
        assert got["cuda_home"] == sys.prefix


def test_what_sam3d_raises_is_the_answer_to_that_request_only(shapes):
    view, segmentation = scene.seen()
    plain = request_arrays(view, segmentation)
    worker = shapes._worker
    with pytest.raises(PerceptionError, match="ValueError: empty mask"):
        worker.ask(Message("request", 0, {**plain, "mask": 0 * plain["mask"]}))
    with pytest.raises(PerceptionError, match="5 opaque points, expected at least 8"):
        worker.ask(Message("request", 0, plain, seed=4))
    assert worker.ask(Message("request", 0, plain)).kind == "answer"


def test_a_checkout_or_a_checkpoint_at_another_place(tmp_path, checkout):
    for folder, what in ((tmp_path, None), (checkout, tmp_path)):
        with (
            Sam3dShape(worker_command(Path(sys.executable), folder, what)) as client,
            pytest.raises(PerceptionError, match=r"no such file, so this is no .* see docs/sam3d\.md"),
        ):
            client.describe(*scene.seen())


def test_check_loads_the_model_and_stops(checkout):
    command = (*worker_command(Path(sys.executable), checkout, checkout / "checkpoints" / "hf"), "--check")
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL)
    assert done.returncode == 0, done.stderr
    assert "SAM 3D Objects is loaded" in done.stderr
    # The pipe for messages stays clean, whatever the model prints.
    assert done.stdout == ""
    assert "Loading model weights" in done.stderr


def test_the_script_needs_only_the_standard_library_numpy_and_python_3_11():
    source = Path(sam3d_worker.__file__).read_text(encoding="utf-8")
    tree = ast.parse(source, feature_version=(3, 11))
    names = [alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in tree.body if isinstance(node, ast.ImportFrom)]
    outside = {name.split(".")[0] for name in names} - set(sys.stdlib_module_names)
    assert outside == {"numpy"}


ARRAYS = st.dictionaries(
    st.text(max_size=5),
    st.sampled_from([np.uint8, np.float32, np.float64]).flatmap(
        lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
    ),
    max_size=3,
)
MESSAGES = st.builds(
    Message,
    st.sampled_from(["request", "answer"]),
    st.integers(0, 2**40),
    ARRAYS,
    st.integers(0, 9),
    st.text(),
)


def stream(data):
    """Reads `data` as a pipe is read."""
    place = [0]

    def read(size):
        place[0] += size
        return data[place[0] - size : place[0]]

    return read


@given(st.lists(MESSAGES, max_size=3))
def test_messages_arrive_as_they_were_sent(messages):
    read = stream(b"".join(map(pack, messages)))
    for message in messages:
        got = read_message(read)
        assert (got.kind, got.id, got.seed, got.text) == (
            message.kind,
            message.id,
            message.seed,
            message.text[:4000],
        )
        assert list(got.arrays) == list(message.arrays)
        for name, array in message.arrays.items():
            assert got.arrays[name].dtype == array.dtype
            np.testing.assert_array_equal(got.arrays[name], array)
    assert read_message(read) is None


@given(MESSAGES, st.data())
def test_spoilt_messages_are_refused_or_read_but_nothing_else_happens(message, data):
    spoilt = bytearray(pack(message))
    for _ in range(data.draw(st.integers(1, 3))):
        spoilt[data.draw(st.integers(0, len(spoilt) - 1))] = data.draw(st.integers(0, 255))
    spoilt = spoilt[: data.draw(st.integers(1, len(spoilt)))]
    try:
        got = read_message(stream(bytes(spoilt)))
    except WireError:
        return
    assert isinstance(got, Message)


@given(MESSAGES, st.data())
def test_every_message_cut_short_is_refused(message, data):
    whole = pack(message)
    with pytest.raises(WireError):
        read_message(stream(whole[: data.draw(st.integers(1, len(whole) - 1))]))


def framed(header):
    return sam3d_worker.PREFIX.pack(sam3d_worker.MAGIC, len(header)) + header


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        (b"[1]", "version 'list'"),
        (b"{}", "version None"),
        (b"\xff", "no JSON"),
        (b"[" * 60000, "no JSON"),
        (b'{"version": 1, "kind": 3}', "'kind' is 3"),
        (b'{"version": 1, "kind": "ready", "id": true}', "'id' is True"),
        (b'{"version": 1, "kind": "a", "id": 1, "seed": 0, "text": "", "arrays": [3]}', "array 3"),
        (
            b'{"version": 1, "kind": "a", "id": 1, "seed": 0, "text": "", '
            b'"arrays": [{"name": "x", "dtype": "uint8", "shape": [-1]}]}',
            "a name, a dtype and a shape",
        ),
        (
            b'{"version": 1, "kind": "a", "id": 1, "seed": 0, "text": "", '
            b'"arrays": [{"name": "x", "dtype": "object", "shape": [1]}]}',
            "dtype 'object'",
        ),
    ],
)
def test_headers_that_are_refused(header, reason):
    with pytest.raises(WireError, match=reason.replace("[", r"\[")):
        read_message(stream(framed(header)))


def test_arrays_that_do_not_travel():
    with pytest.raises(WireError, match="dtype int64"):
        pack(Message("request", 1, {"x": np.arange(3)}))
