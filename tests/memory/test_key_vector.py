import hashlib
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.key_vector import DIMENSIONS, key_vector, key_vectors
from lerobot_openspm.types import Reference, SubTask

names = st.text("abc ", max_size=8).map(lambda text: " ".join(text.split()))
references = st.none() | st.builds(Reference, names, st.tuples(names, names))
sub_tasks = st.builds(SubTask, names, names, names, names, names, references, references)
keys = st.lists(sub_tasks, min_size=1, max_size=3)


def cosine(one, other):
    return float(key_vector(parse_instruction(one)) @ key_vector(parse_instruction(other)))


@given(keys)
def test_vectors_are_of_unit_length(key):
    vector = key_vector(key)
    assert (vector.shape, vector.dtype) == ((DIMENSIONS,), np.float32)
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-5)


@given(st.lists(keys, min_size=1, max_size=5))
def test_many_at_once_are_bit_by_bit_those_one_by_one(many):
    assert np.array_equal(key_vectors(many), np.stack([key_vector(key) for key in many]))


@given(keys, keys)
def test_equal_keys_alone_have_equal_vectors(one, other):
    assert (one == other) == np.array_equal(key_vector(one), key_vector(other))


def test_no_keys_and_a_key_of_nothing():
    assert key_vectors([]).shape == (0, DIMENSIONS)
    assert not key_vector(()).any()


def test_every_element_counts():
    key = SubTask("put", "bowl", "top drawer", "in", "cabinet")
    near = Reference("next to", ("stove",))
    others = [
        SubTask("push", "bowl", "top drawer", "in", "cabinet"),
        SubTask("put", "plate", "top drawer", "in", "cabinet"),
        SubTask("put", "bowl", "", "in", "cabinet"),
        SubTask("put", "bowl", "top drawer", "under", "cabinet"),
        SubTask("put", "bowl", "top drawer", "in", "rack"),
        SubTask("put", "bowl", "top drawer", "in", "cabinet", near),
        SubTask("put", "bowl", "top drawer", "in", "cabinet", None, near),
    ]
    cosines = key_vectors([[other] for other in others]) @ key_vector([key])
    assert (cosines < 0.99).all()
    assert len(set(cosines.tolist())) == len(others)


def test_close_keys_are_close():
    asked = "put the bottle on the rack"
    by_nearness = [
        "put the wine bottle on the rack",
        "put the bottle on the stove",
        "open the top drawer",
    ]
    assert cosine(asked, "place the bottle onto the rack") == pytest.approx(1)
    cosines = [cosine(asked, known) for known in by_nearness]
    assert cosines == sorted(cosines, reverse=True)
    assert cosines[0] > 0.8
    assert cosines[-1] < 0.5


def test_the_order_of_sub_tasks_counts():
    there, back = parse_instruction("open the drawer and turn on the stove"), parse_instruction(
        "turn on the stove and open the drawer"
    )  # fmt: skip
    assert key_vector(there) @ key_vector(back) < 0.8


def test_every_process_and_release_makes_the_same_vectors():
    code = (
        "import hashlib; from lerobot_openspm.memory.entry import SubTask; "
        "from lerobot_openspm.memory.key_vector import key_vector; "
        "vector = key_vector([SubTask('put', 'wine bottle', '', 'on', 'rack')]); "
        "print(hashlib.sha256(vector.round(4).tobytes()).hexdigest())"
    )
    runs = [
        subprocess.run(
            [sys.executable, "-c", code], env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)},
            capture_output=True, text=True, check=True,
        ).stdout.strip()
        for seed in ("1", "2")
    ]  # fmt: skip
    here = key_vector([SubTask("put", "wine bottle", "", "on", "rack")])
    assert runs == [hashlib.sha256(here.round(4).tobytes()).hexdigest()] * 2
    assert here[:4].round(4).tolist() == pytest.approx([-0.0542, 0.1285, 0.0558, 0.1609], abs=1e-4)
