"""Choosing a backend by its name."""

import subprocess
import sys

import pytest
from tests.perception.segmentation import tiny_models

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.given import GivenSegmenter
from lerobot_openspm.perception.segmentation.grounded_sam2 import GroundedSam2Segmenter
from lerobot_openspm.perception.segmentation.make import WEIGHTS, make_segmenter
from lerobot_openspm.perception.segmentation.sam3 import Sam3Segmenter


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A folder of weights for each model."""
    saved = {}
    for name in ("sam3", "grounding_dino", "sam2"):
        tiny = getattr(tiny_models, name)()
        saved[name] = str(tmp_path_factory.mktemp(name))
        tiny.model.save_pretrained(saved[name])
        tiny.processor.save_pretrained(saved[name])
    return saved


def test_nothing_heavy_is_imported_before_it_is_needed():
    code = (
        "import sys; from lerobot_openspm.perception.segmentation.make import make_segmenter; "
        "make_segmenter('given', {}); sys.exit(bool({'torch', 'transformers'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_each_name_makes_its_backend(folders):
    weights = {"sam3": [folders["sam3"]], "grounded_sam2": [folders["grounding_dino"], folders["sam2"]]}
    made = [make_segmenter(name, {}, weights.get(name, ())) for name in WEIGHTS]
    assert [type(one) for one in made] == [Sam3Segmenter, GroundedSam2Segmenter, GivenSegmenter]


def test_the_default_weights_are_the_ones_that_the_authors_publish():
    assert WEIGHTS["sam3"] == ("facebook/sam3",)
    assert WEIGHTS["grounded_sam2"] == (
        "IDEA-Research/grounding-dino-tiny",
        "facebook/sam2.1-hiera-tiny",
    )


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(PerceptionError, match="no segmenter 'sam'; choose one of sam3, grounded_sam2, g"):
        make_segmenter("sam", {})


@pytest.mark.parametrize(
    ("kind", "weights", "message"),
    [
        (
            "sam3",
            ["a", "b"],
            "takes 1 names of weights, got 2: a, b; .* by default: facebook/sam3",
        ),
        ("grounded_sam2", ["a"], "takes 2 names of weights, got 1: a; .*sam2.1-hiera-tiny"),
        ("given", ["a"], "takes 0 names of weights, got 1: a; .*none"),
    ],
)
def test_the_wrong_number_of_weights_is_refused(kind, weights, message):
    with pytest.raises(PerceptionError, match=message):
        make_segmenter(kind, {}, weights)
