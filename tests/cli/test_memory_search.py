"""`openspm memory search`, typed as a user types it, on the tests' small checkpoint."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from tests.cli.conftest import Openspm

from lerobot_openspm.memory.io import arrays_file, read_memory, write_memory
from lerobot_openspm.workplaces import join

BOWL = "put the bowl on the plate"


def search(openspm: Openspm, *arguments: str) -> tuple[str, dict]:
    code, out, _ = openspm("memory", "search", *arguments)
    assert code == 0
    *lines, last = out.splitlines()
    return "\n".join(lines), json.loads(last)


def test_without_a_scene_two_terms_are_shown(openspm: Openspm, checkpoint: Path):
    text, found = search(openspm, "place the bowl onto the plate", f"--path={checkpoint}", "--limit=2")
    assert "asked: operation: put, target: bowl, relation: on, landmark: plate" in text
    assert text.count("'put the bowl on the plate' from local/openspm_tabletop#") == 2
    assert "turn on the stove" not in text
    assert "... 1 more; --limit=3 lists all" in text
    assert "... 1 more of other tasks; --limit=4 lists all" in text
    assert (found["considered"], found["refusal"], found["status"], found["objects"]) == (3, None, None, {})
    for hit in found["entries"]:
        assert hit["geometric"] is None
        assert hit["total"] == pytest.approx(hit["semantic"] + 0.5 * hit["quality"])
    assert f"{found['entries'][0]['total']:.3f}  1.000      - " in text


def test_in_a_scene_all_three_are_and_the_scenes_own_demonstration_fits_best(
    openspm: Openspm, checkpoint: Path, tiny_dataset: Path
):
    scene = (f"--path={checkpoint}", f"--dataset.root={tiny_dataset}", "--episode=1")
    text, found = search(openspm, BOWL, *scene)
    assert found["objects"] == {"bowl": True, "plate": True}
    assert "objects: bowl found, plate found" in text
    assert found["status"] == "running"
    considered = found["entries"][: found["considered"]]
    assert len(considered) == 3
    best = max(considered, key=lambda hit: hit["geometric"])
    assert best["source"].endswith("#1")
    assert 0.9 < best["geometric"] <= 1
    for hit in considered:
        terms = hit["semantic"] + 0.5 * hit["geometric"] + 0.5 * hit["quality"]
        assert hit["total"] == pytest.approx(terms)
        assert f"{hit['geometric']:.3f}" in text
    assert [hit["geometric"] for hit in found["entries"][3:]] == [None]
    assert " more; " not in text


def test_what_the_policy_refuses_says_why_and_what_is_nearest(
    openspm: Openspm, checkpoint: Path, tiny_dataset: Path
):
    for scene in ([], [f"--dataset.root={tiny_dataset}"]):
        text, found = search(openspm, "put the bowl on the rack", f"--path={checkpoint}", *scene)
        assert found["considered"] == 0
        assert "holds no entry for the instruction 'put the bowl on the rack'" in found["refusal"]
        assert f"refused: {found['refusal']}" in text
        assert found["entries"][0]["language"] == BOWL
        assert [hit["geometric"] for hit in found["entries"]] == [None, None]


def test_in_a_scene_a_sequence_of_known_tasks_is_shown_part_by_part(
    openspm: Openspm, checkpoint: Path, tiny_dataset: Path
):
    asked, scene = f"turn on the stove and {BOWL}", f"--dataset.root={tiny_dataset}"
    text, found = search(openspm, asked, f"--path={checkpoint}", scene, "--limit=2")
    assert (found["refusal"], found["parts"], found["considered"]) == (None, 2, 6)
    assert [hit["part"] for hit in found["entries"]] == [1, 1, 2, 2]
    assert [hit["language"] for hit in found["entries"]] == ["turn on the stove"] * 2 + [BOWL] * 2
    assert [hit["geometric"] is None for hit in found["entries"]] == [False, False, True, True]
    assert found["status"] == "running"
    assert text.index("part 1 of 2:") < text.index("part 2 of 2:") < text.index(f"{BOWL!r} from")


def test_a_mined_memory_can_be_searched_too(openspm: Openspm, checkpoint: Path, tmp_path: Path):
    for file in ("memory.json", arrays_file(checkpoint)):
        (tmp_path / file).write_bytes((checkpoint / file).read_bytes())
    assert search(openspm, BOWL, f"--path={tmp_path}") == search(openspm, BOWL, f"--path={checkpoint}")


def test_of_several_workplaces_that_of_the_scene_is_searched_in_the_words_of_all(
    openspm: Openspm, checkpoint: Path, tiny_dataset: Path, tmp_path: Path
):
    far, both = Path(shutil.copytree(checkpoint, tmp_path / "far")), tmp_path / "both"
    memory = read_memory(far)
    robot = replace(memory.robot, workspace=memory.robot.workspace + 5)
    stove = tuple(entry for entry in memory.entries if entry.language != BOWL)
    write_memory(replace(memory, entries=stove, robot=robot), far)
    join([far, checkpoint], both)
    config = json.loads((both / "config.json").read_text())
    (both / "config.json").write_text(json.dumps({**config, "lexicon": '{"synonyms": {"bowl": ["tureen"]}}'}))
    asked = "put the tureen on the plate"
    _, found = search(openspm, asked, f"--path={both}", f"--dataset.root={tiny_dataset}")
    assert (found["refusal"], found["status"], found["considered"]) == (None, "running", 3)
    _, found = search(openspm, asked, f"--path={both / 'workplaces' / '1'}")
    assert (found["refusal"], found["considered"]) == (None, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "search for what? expected an instruction in quotes before the options"),
        ((BOWL, "--path=nowhere"), "no memory at nowhere"),
        (("...",), "says nothing"),
        ((BOWL, "--dataset.root=nowhere"), "no dataset in nowhere: it has no meta/info.json"),
        ((BOWL, "--dataset.root={dataset}", "--episode=6"), "has episodes 0 to 5, got --episode=6"),
        ((BOWL, "--dataset.root={dataset}", "--frame=-1"), "got --frame=-1"),
        ((BOWL, "--episode=1"), "--episode of which dataset? pass --dataset.root=FOLDER"),
        ((BOWL, "--frame=0"), "--frame of which dataset? pass --dataset.root=FOLDER"),
        ((BOWL, "--limit=-1"), "limit is -1, expected"),
    ],
)
def test_mistakes_are_one_line(
    openspm: Openspm, checkpoint: Path, tiny_dataset: Path, arguments: tuple[str, ...], message: str
):
    arguments = tuple(argument.format(dataset=tiny_dataset) for argument in arguments)
    path = [] if any(argument.startswith("--path") for argument in arguments) else [f"--path={checkpoint}"]
    code, out, err = openspm("memory", "search", *arguments, *path)
    assert code == 2
    assert "{" not in out  # LeRobot says on stdout that it loads weights
    assert err.splitlines()[-1].startswith("openspm memory search: ")
    assert message in err.splitlines()[-1]
