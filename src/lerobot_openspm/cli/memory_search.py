"""`openspm memory search "put the bowl on the plate"`: what an instruction finds, and how it is scored."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import draccus

from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.experience import load_experience
from lerobot_openspm.memory.entry import Reference, SubTask
from lerobot_openspm.memory.retrieval import ScoreWeights
from lerobot_openspm.search import Found, Hit, observation_of, search_memory, search_scene


@dataclass
class SceneOption:
    """A dataset, out of which one frame is the scene; without one, nothing is said of geometry."""

    root: str | None = None  # its folder
    repo_id: str | None = None  # its name on the Hub


@dataclass
class SearchConfig:
    """Show what an instruction finds in a memory: openspm memory search "put the bowl on the plate".

    Args:
        path: Folder of the checkpoint or of a mined memory; to look at a scene it has to be a checkpoint.
        limit: Show at most this many entries.
        dataset: The demonstrations or recordings to take the scene from.
        episode: Number of the episode in it.
        frame: Number of the frame in the episode.
    """

    path: str = "outputs/memory"
    limit: int = 10
    dataset: SceneOption = field(default_factory=SceneOption)
    episode: int = 0
    frame: int = 0


def search(args: list[str]) -> None:
    """Print the instruction's elements and the entries it finds, then one JSON object."""
    # The instruction comes first, because a word among the options may be an option's value.
    words = [arg for arg in args[:1] if not arg.startswith("-")]
    config = draccus.parse(SearchConfig, args=args[len(words) :])
    if not words:
        raise OpenSPMError(
            "search for what? expected an instruction in quotes before the options: "
            'openspm memory search "put the bowl on the plate" --path=CHECKPOINT'
        )
    found = _search(words[0], config)
    print("\n".join(_lines(found, config.limit)))
    print(json.dumps({"instruction": words[0], **_summary(found, config.limit)}))


def _search(instruction: str, config: SearchConfig) -> Found:
    if config.dataset.root is None and config.dataset.repo_id is None:
        return search_memory(instruction, load_experience(Path(config.path)).entries, _weights(config.path))
    if config.dataset.root is not None and not (Path(config.dataset.root) / "meta/info.json").is_file():
        raise FileNotFoundError(f"no dataset at --dataset.root={config.dataset.root}")
    from lerobot.datasets import LeRobotDataset

    from lerobot_openspm.modeling_openspm import OpenSPMPolicy

    policy = OpenSPMPolicy.from_pretrained(config.path)
    name = config.dataset.repo_id or f"local/{Path(str(config.dataset.root)).name}"
    dataset = LeRobotDataset(name, root=config.dataset.root, video_backend="pyav")
    return search_scene(policy, observation_of(policy, dataset, config.episode, config.frame, instruction))


def _weights(path: str) -> ScoreWeights:
    """The weights that a checkpoint was given; a mined memory has none of its own."""
    if not (Path(path) / "config.json").is_file():
        return ScoreWeights()
    from lerobot_openspm.configuration_openspm import OpenSPMConfig

    return OpenSPMConfig.from_pretrained(path).score_weights  # pyright: ignore[reportAttributeAccessIssue]


def _lines(found: Found, limit: int) -> list[str]:
    lines = [f"asked: {_sub_task(sub_task)}" for sub_task in found.asked]
    if found.seen:
        lines.append(
            "objects: " + ", ".join(f"{n} {'found' if s else 'not found'}" for n, s in found.seen.items())
        )
    lines += [f"refused: {found.refusal}"] if found.refusal else []
    lines += [f"status: {found.status}"] if found.status else []
    if found.hits:
        lines.append(f"  {'total':>6s} {'S_sem':>6s} {'S_geo':>6s} {'r':>6s}  entry")
    for i, hit in enumerate(found.hits[:limit]):
        if i == found.considered:
            lines.append("  not considered, the best entry of each task:")
        lines.append(_hit(hit))
    return lines


def _hit(hit: Hit) -> str:
    geometric = "-" if hit.geometric is None else f"{hit.geometric:.3f}"
    terms = f"{hit.total:6.3f} {hit.semantic:6.3f} {geometric:>6s} {hit.entry.quality:6.3f}"
    return f"  {terms}  {hit.entry.language!r} from {hit.entry.source}, version {hit.entry.version}"


def _sub_task(sub_task: SubTask) -> str:
    """A sub-task as "operation: put, target: bowl, relation: on, landmark: plate"."""
    said = [(name, value) for name, value in vars(sub_task).items() if value]
    return ", ".join(
        f"{name.replace('_', ' ')}: {_reference(value) if isinstance(value, Reference) else value}"
        for name, value in said
    )


def _reference(reference: Reference) -> str:
    return " ".join([reference.relation, " and ".join(reference.landmarks)]).strip()


def _summary(found: Found, limit: int) -> dict[str, Any]:
    entries = [
        {
            "language": hit.entry.language, "source": hit.entry.source, "semantic": hit.semantic,
            "geometric": hit.geometric, "quality": hit.entry.quality, "total": hit.total,
        }
        for hit in found.hits[:limit]
    ]  # fmt: skip
    return {
        "asked": [asdict(sub_task) for sub_task in found.asked],
        "considered": found.considered,
        "refusal": found.refusal or None,
        "status": found.status or None,
        "objects": found.seen,
        "entries": entries,
    }
