"""The page that a person opens first: success per task, films, key poses drawn into a camera image."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, select_autoescape
from lerobot.datasets import LeRobotDataset
from tqdm import tqdm

from lerobot_openspm.cli.drawing import draw_key_poses, save_png
from lerobot_openspm.cli.pipeline import REPO_ID, Episode, mean_steps, rate
from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.envs.tabletop.tasks import TASKS
from lerobot_openspm.memory.entry import MemoryEntry, episode_of
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.memory.memory import Memory
from lerobot_openspm.training import open_demonstrations

# Rollouts shown per task: this many that succeeded, and this many that failed.
SHOWN_SUCCESSES, SHOWN_FAILURES = 1, 2


def write_report(
    folder: Path,
    result: dict[str, Any],
    episodes: Sequence[Episode],
    dataset: Path,
    checkpoint: Path,
    evaluation: Path,
) -> Path:
    """Draw the pictures and write ``index.html``. Returns its path."""
    memory = read_memory(checkpoint)
    demonstrations = LeRobotDataset(REPO_ID, root=dataset, video_backend="pyav")
    tasks = []
    for name in tqdm(dict.fromkeys(e.task for e in episodes), desc="Drawing", unit="task"):
        own = [e for e in episodes if e.task == name]
        instruction = TASKS[name].instruction
        entries = [entry for entry in memory.entries if entry.language == instruction]
        best = max(entries, key=lambda entry: entry.quality, default=None)
        poses = folder / f"{name}_key_poses.png"
        if best is not None:
            save_png(_key_pose_picture(best, memory, demonstrations), poses)
        tasks.append(
            {
                "instruction": instruction,
                **rate(sum(e.success for e in own), len(own)),
                "mean_steps": mean_steps(own),
                "entries": len(entries),
                "anchors": ", ".join(best.objects) if best else "",
                "poses": poses.name if best else None,
                "films": _films(own, evaluation, folder),
            }
        )
    template = files("lerobot_openspm.cli").joinpath("templates/report.html").read_text()
    page = Environment(autoescape=select_autoescape()).from_string(template)
    path = folder / "index.html"
    path.write_text(page.render(title="OpenSPM on the tabletop", tasks=tasks, **result))
    return path


def _key_pose_picture(entry: MemoryEntry, memory: Memory, dataset: LeRobotDataset) -> Any:
    """The entry's key poses in the first frame of the demonstration it was mined from."""
    config = OpenSPMConfig(device="cpu", push_to_hub=False)
    demonstrations = open_demonstrations(dataset.meta, config)
    episode = demonstrations.episodes([episode_of(entry.source)])[0]
    key, camera = next((k, c) for k, c in memory.cameras.items() if c.mount == "world")
    view = demonstrations.views(episode, 0, {key: camera})[key]
    poses = [pose.anchor.frame(entry.object_poses) @ pose.T_obj_ee for pose in entry.key_poses]
    return draw_key_poses(view, poses, [pose.phase for pose in entry.key_poses])


def _films(episodes: Sequence[Episode], evaluation: Path, folder: Path) -> list[dict[str, Any]]:
    """A few rollouts; lerobot-eval films the first ten of a task, in the order of seeds."""
    task_id = list(TASKS).index(episodes[0].task)
    videos = next(evaluation.glob(f"lerobot_eval_*/videos/openspm_tabletop_{task_id}"), evaluation)
    filmed = [
        (episode, video)
        for i, episode in enumerate(sorted(episodes, key=lambda e: e.seed))
        if (video := videos / f"eval_episode_{i}.mp4").exists()
    ]
    successes = [item for item in filmed if item[0].success][:SHOWN_SUCCESSES]
    failures = [item for item in filmed if not item[0].success][:SHOWN_FAILURES]
    return [
        {
            "video": os.path.relpath(video, folder),
            "seed": episode.seed,
            "ended": "success" if episode.success else f"failed ({episode.status.replace('_', ' ')})",
            "steps": episode.steps,
        }
        for episode, video in successes + failures
    ]
