"""A checkpoint goes to the Hub and comes back with everything that the policy knows."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
from tests.hub.loopback_hub import LoopbackHub
from tests.memory.memory_files import names

from lerobot_openspm.cli.join import main as join
from lerobot_openspm.memory.io import read_memory, write_memory

REPO = "tester/openspm-tabletop"

# Acts on recorded observations; what is printed says which actions came out, to the last bit.
ACT = """
import hashlib, json, sys
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_pre_post_processors
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.modeling_openspm import OpenSPMPolicy

def act(policy, pre, post, root):
    dataset = LeRobotDataset("local/openspm_tabletop", root=root, video_backend="pyav")
    policy.reset()
    actions = []
    for i in range(6):
        frame = {k: v for k, v in dataset[i].items() if k.startswith("observation.") or k == "task"}
        with torch.inference_mode():
            actions.append(post(policy.select_action(pre(frame))))
    actions = torch.cat(actions)
    assert torch.isfinite(actions).all() and actions.abs().max() > 0
    return hashlib.sha256(actions.numpy().tobytes()).hexdigest()
"""

PUSH = """
from huggingface_hub import ModelCard
from lerobot.configs.train import TrainPipelineConfig
path, root, repo = sys.argv[1:]
# It asks huggingface.co by name, whatever HF_ENDPOINT says.
ModelCard.validate = lambda self, repo_type=None: None
config = OpenSPMConfig.from_pretrained(path)
config.repo_id = repo
policy = OpenSPMPolicy.from_pretrained(path, config=config)
pre, post = make_pre_post_processors(config, path)
train_config = TrainPipelineConfig.from_pretrained(path)
policy.push_model_to_hub(train_config)
pre.push_to_hub(repo)
post.push_to_hub(repo)
print(json.dumps(act(policy, pre, post, root)))
"""

PULL = """
root, repo = sys.argv[1:]
policy = OpenSPMPolicy.from_pretrained(repo)
pre, post = make_pre_post_processors(policy.config, repo)
print(json.dumps([act(policy, pre, post, root), len(policy.memory.entries)]))
"""

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def run(loopback_hub: LoopbackHub, tmp_path: Path) -> Run:
    """Run code in a process for which the loopback Hub is the Hub, in a folder that knows nothing of ours."""

    def run(code: str, *arguments: object, home: str, offline: bool = False):
        return subprocess.run(
            [sys.executable, "-c", dedent(code), *map(str, arguments)],
            env=loopback_hub.env(tmp_path / home, offline=offline) | {"OMP_NUM_THREADS": "1"},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=180,
            check=False,
        )

    return run


def answer(done: subprocess.CompletedProcess[str]) -> Any:
    assert done.returncode == 0, done.stderr[-4000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_what_is_pulled_acts_as_what_was_pushed_and_a_deleted_memory_is_told(
    run: Run, loopback_hub: LoopbackHub, checkpoint: Path, tiny_dataset: Path
):
    actions = answer(run(ACT + PUSH, checkpoint, tiny_dataset, REPO, home="home_a"))
    files = loopback_hub.files(REPO)
    assert set(files) >= {
        "config.json", "model.safetensors", "train_config.json", "README.md", "policy_preprocessor.json",
        "policy_postprocessor.json", *names(checkpoint),
    }  # fmt: skip
    for name in names(checkpoint):
        assert files[name] == (checkpoint / name).read_bytes(), name

    assert answer(run(ACT + PULL, tiny_dataset, REPO, home="home_b")) == [actions, 6]
    # Everything is in the cache now, and nothing is asked for without a connection.
    requests = len(loopback_hub.requests)
    assert answer(run(ACT + PULL, tiny_dataset, REPO, home="home_b", offline=True)) == [actions, 6]
    assert len(loopback_hub.requests) == requests

    # Whoever deletes the memory is told so, and not given a policy without one.
    commit = loopback_hub.repo("models", REPO)
    gone = names(checkpoint)[1]
    commit.commit({path: content for path, content in files.items() if path != gone}, "oops")
    broken = run(ACT + PULL, tiny_dataset, REPO, home="home_c")
    assert broken.returncode != 0
    assert "MemoryFormatError: no memory at" in broken.stderr
    assert "pull the whole checkpoint" in broken.stderr


@pytest.mark.slow
def test_a_changed_memory_is_pushed_again_and_what_it_was_before_is_not_pulled(
    run: Run, loopback_hub: LoopbackHub, checkpoint: Path, tiny_dataset: Path, tmp_path: Path
):
    first = answer(run(ACT + PUSH, checkpoint, tiny_dataset, REPO, home="home_a"))
    changed = Path(shutil.copytree(checkpoint, tmp_path / "changed"))
    memory = read_memory(changed)
    write_memory(replace(memory, entries=memory.entries[:5]), changed)
    answer(run(ACT + PUSH, changed, tiny_dataset, REPO, home="home_a"))
    files = loopback_hub.files(REPO)
    # LeRobot's upload deletes nothing.
    assert {*names(checkpoint), *names(changed)} <= set(files)
    stale = set(names(checkpoint)) - set(names(changed))
    assert len(stale) == 1

    loopback_hub.requests.clear()
    assert answer(run(ACT + PULL, tiny_dataset, REPO, home="home_b")) == [first, 5]
    assert not [request for request in loopback_hub.requests if any(name in request for name in stale)]
    # A cache that holds the one before gets the new one.
    answer(run(ACT + PUSH, checkpoint, tiny_dataset, REPO, home="home_a"))
    assert answer(run(ACT + PULL, tiny_dataset, REPO, home="home_b")) == [first, 6]


@pytest.mark.slow
def test_the_memory_of_every_workplace_is_pulled(
    run: Run, loopback_hub: LoopbackHub, checkpoint: Path, tiny_dataset: Path, tmp_path: Path
):
    far = Path(shutil.copytree(checkpoint, tmp_path / "far"))
    memory = read_memory(far)
    robot = replace(memory.robot, workspace=memory.robot.workspace + 5)
    write_memory(replace(memory, entries=memory.entries[:5], robot=robot), far)
    join([f"--policy.paths=[{far},{checkpoint}]", f"--output_dir={tmp_path / 'joined'}"])
    here = answer(run(ACT + PUSH, tmp_path / "joined", tiny_dataset, REPO, home="home_a"))
    assert {f"workplaces/1/{name}" for name in names(checkpoint)} <= set(loopback_hub.files(REPO))
    # The hand is not where the first memory has it, whose entries are counted.
    assert answer(run(ACT + PULL, tiny_dataset, REPO, home="home_b")) == [here, 5]
    assert here == answer(run(ACT + PUSH, checkpoint, tiny_dataset, f"{REPO}-alone", home="home_a"))
