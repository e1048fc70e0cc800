"""`openspm memory search "put the bowl on the plate"`: what an instruction finds, and how it is scored."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import draccus

from lerobot_openspm.cli.memory import LimitOption
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.language.lexicon import read_lexicon
from lerobot_openspm.language.names import TABLE_NAMES, NameSimilarity, names_from
from lerobot_openspm.memory.io import WORKPLACES, read_memory
from lerobot_openspm.search import Found, Hit, observation_of, search_memory, search_scene
from lerobot_openspm.types import Reference, SubTask


@dataclass
class SceneOption:
    """A dataset, out of which one frame is the scene; without one, nothing is said of geometry."""

    root: str | None = None  # its folder
    repo_id: str | None = None  # its name on the Hub


@dataclass
class SearchConfig(LimitOption):
    """Show what an instruction finds in a memory: openspm memory search "put the bowl on the plate".

    To look at a scene, the path has to be a checkpoint's. Of an instruction in several parts, the limit holds
    for each of them.
    """

    dataset: SceneOption = field(default_factory=SceneOption)  # to take the scene from
    episode: int | None = None  # number of the episode in it; the first if not given
    frame: int | None = None  # number of the frame in the episode; the first if not given

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [f"--{name}" for name in ("episode", "frame") if getattr(self, name) is not None]
        if given and self.dataset.root is None and self.dataset.repo_id is None:
            raise ValueError(
                f"{' and '.join(given)} of which dataset? pass --dataset.root=FOLDER with the demonstrations "
                "to take the scene from, or leave it out to search without a scene"
            )


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
        memory = read_memory(Path(config.path))
        return search_memory(instruction, memory.entries, _names(config.path), memory.looks)
    from lerobot_openspm.mining.dataset import dataset_metadata, open_dataset
    from lerobot_openspm.modeling_openspm import OpenSPMPolicy

    name = config.dataset.repo_id or f"local/{Path(str(config.dataset.root)).name}"
    dataset = open_dataset(dataset_metadata(name, config.dataset.root))
    policy = OpenSPMPolicy.from_pretrained(config.path)
    episode, frame = config.episode or 0, config.frame or 0
    return search_scene(policy, observation_of(policy, dataset, episode, frame, instruction))


def _names(path: str) -> NameSimilarity:
    """The names that a checkpoint was given, for all its workplaces; a mined memory has none of its own."""
    folder = Path(path)
    if folder.parent.name == WORKPLACES:
        folder = folder.parent.parent
    if not (folder / "config.json").is_file():
        return TABLE_NAMES
    from lerobot_openspm.configuration_openspm import OpenSPMConfig

    config: Any = OpenSPMConfig.from_pretrained(folder)
    return names_from(config.name_embeddings, read_lexicon(config.lexicon))


def _lines(found: Found, limit: int) -> list[str]:
    lines = [f"asked: {_sub_task(sub_task)}" for sub_task in found.asked]
    if found.seen:
        lines.append(
            "objects: " + ", ".join(f"{n} {'found' if s else 'not found'}" for n, s in found.seen.items())
        )
    lines += [f"refused: {found.refusal}"] if found.refusal else []
    lines += [f"status: {found.status}"] if found.status else []
    if found.parts or found.others:
        lines.append(f"  {'total':>6s} {'S_sem':>6s} {'S_geo':>6s} {'r':>6s}  entry")
    for number, part in enumerate(found.parts, start=1):
        lines += [f"  part {number} of {len(found.parts)}:"] if len(found.parts) > 1 else []
        lines += [_hit(hit) for hit in part[:limit]]
        left_out = len(part) - limit
        lines += [f"  ... {left_out} more; --limit={len(part)} lists all"] if left_out > 0 else []
    if others := _others(found, limit):
        lines += ["  not considered, the best entry of each other task:", *map(_hit, others)]
    if left_out := len(found.others) - len(others):
        n_all = sum(map(len, found.parts)) + len(found.others)
        lines.append(f"  ... {left_out} more of other tasks; --limit={n_all} lists all")
    return lines


def _others(found: Found, limit: int) -> tuple[Hit, ...]:
    """As many of those that are not considered as there is room for."""
    return found.others[: max(0, limit - sum(len(part) for part in found.parts))]


def _hit(hit: Hit) -> str:
    geometric = "-" if hit.geometric is None else f"{hit.geometric:.3f}"
    terms = f"{hit.total:6.3f} {hit.semantic:6.3f} {geometric:>6s} {hit.entry.quality:6.3f}"
    first, *others = hit.sources
    if others:
        return (
            f"  {terms}  {hit.entry.language!r}, put together: grasped as in {first.language!r} from "
            f"{first.source}, placed as in {others[0].language!r} from {others[0].source}"
        )
    of = f", a part of {first.language!r}," if hit.entry is not first else ""
    return f"  {terms}  {hit.entry.language!r}{of} from {hit.entry.source}, version {hit.entry.version}"


def _sub_task(sub_task: SubTask) -> str:
    """A sub-task as "operation: put, target: bowl, relation: on, landmark: plate"."""
    said = {field.name: getattr(sub_task, field.name) for field in fields(sub_task)}
    return ", ".join(
        f"{name.replace('_', ' ')}: {_reference(value) if isinstance(value, Reference) else value}"
        for name, value in said.items()
        if value
    )


def _reference(reference: Reference) -> str:
    return " ".join([reference.relation, " and ".join(reference.landmarks)]).strip()


def _summary(found: Found, limit: int) -> dict[str, Any]:
    shown = [(number, hit) for number, part in enumerate(found.parts, start=1) for hit in part[:limit]]
    entries = [
        {
            "language": hit.entry.language, "source": hit.entry.source, "semantic": hit.semantic,
            "geometric": hit.geometric, "quality": hit.entry.quality, "total": hit.total, "part": number,
        }
        for number, hit in [*shown, *((None, hit) for hit in _others(found, limit))]
    ]  # fmt: skip
    return {
        "asked": [asdict(sub_task) for sub_task in found.asked],
        "parts": len(found.parts),
        "considered": sum(map(len, found.parts)),
        "refusal": found.refusal or None,
        "status": found.status or None,
        "objects": found.seen,
        "entries": entries,
    }
