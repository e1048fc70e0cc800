"""`openspm bench teach`, typed as a user types it, on the tests' small dataset."""

import json
from pathlib import Path

import pytest
from tests.cli.conftest import Openspm

from lerobot_openspm.memory.io import read_memory


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--env.type=libero",), "bench teach measures on openspm_tabletop, got env.type=libero"),
        (("--episodes=0",), "episodes must be at least 1, got 0"),
        (("--env.task=juggle",), "unknown openspm_tabletop task juggle"),
        (("--dataset.root=nowhere",), "no dataset in nowhere"),
    ],
)
def test_mistakes_are_one_line(openspm: Openspm, options: tuple[str, ...], message: str):
    code, out, err = openspm("bench", "teach", *options)
    assert (code, out) == (2, "")
    assert message in err.splitlines()[-1]


def test_too_few_demonstrations_are_refused(openspm: Openspm, tiny_dataset: Path, tmp_path: Path):
    code, _, err = openspm("bench", "teach", f"--dataset.root={tiny_dataset}", f"--output={tmp_path / 'out'}")
    assert code == 2
    assert "holds 0 demonstrations of bowl_on_stove, expected at least 3" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_teaching_is_measured_and_goes_on_where_it_was(openspm: Openspm, tiny_dataset: Path, tmp_path: Path):
    output = tmp_path / "out"
    arguments = (
        "bench", "teach", f"--dataset.root={tiny_dataset}", "--env.task=turn_on_stove", "--episodes=1",
        "--seed=2000000", "--steps=20", "--workers=1", f"--output={output}",
    )  # fmt: skip
    code, out, err = openspm(*arguments)
    assert code == 0, err
    result = json.loads(out.splitlines()[-1])
    assert list(result)[:4] == ["teach_s", "success_1_demo", "success_3_demos", "n"]
    assert result["n"] == 1
    assert 0 < result["teach_s"] < 60
    # The policy that is taught has never seen the task. In its first demonstration no stove is found, because
    # the images are small, so one is not enough; three are.
    nine = read_memory(output / "without_turn_on_stove")
    assert {entry.language for entry in nine.entries} == {"put the bowl on the plate"}
    assert set(nine.objects) == {"bowl", "plate"}
    taught = [read_memory(output / f"taught_turn_on_stove_{n}").entries for n in (1, 3)]
    assert [len(entries) for entries in taught] == [3, 6]
    failed, learned = result["lessons"]
    assert "the objects they belong to were found in none" in failed["error"]
    assert (learned["error"], learned["objects_learned"]) == (None, ["stove"])
    weights = [
        (output / name / "model.safetensors") for name in ("without_turn_on_stove", "taught_turn_on_stove_1")
    ]
    assert weights[0].read_bytes() == weights[1].read_bytes()
    log = output / "episodes.jsonl"
    lines = log.read_text().splitlines()
    assert [json.loads(line)["condition"] for line in lines] in (["1", "3"], ["3", "1"])
    before = weights[0].stat().st_mtime_ns
    log.write_text(f'{lines[0]}\n{{"torn')
    assert json.loads(openspm(*arguments)[1].splitlines()[-1]) == result
    assert weights[0].stat().st_mtime_ns == before
