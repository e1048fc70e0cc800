"""A dataset is written again with what was mined of it, for LeRobot's viewers and for other policies."""

import os
import shutil
import stat
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lerobot.annotations.steerable_pipeline.reader import iter_episodes, reconstruct_subtask_spans
from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
from lerobot.annotations.steerable_pipeline.writer import LanguageColumnsWriter, speech_atom
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.io_utils import load_info, write_info
from lerobot.datasets.language import language_feature_info
from tests.memory.builders import robot
from tests.mining.test_dataset_layers import dataset as image_dataset

from lerobot_openspm.configuration_openspm import JudgeConfig, OpenSPMConfig
from lerobot_openspm.errors import DatasetError
from lerobot_openspm.language.descriptions import phases_of
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.mining import annotate, processor
from lerobot_openspm.mining.annotate import write_annotated
from lerobot_openspm.mining.columns import IS_KEY_POSE, KEY_POSE, PHASE, TARGET, TYPES
from lerobot_openspm.mining.key_poses import KeyPose
from lerobot_openspm.mining.mined import MinedEpisode, MinedKeyPoses
from lerobot_openspm.mining.processor import DatasetProcessor
from lerobot_openspm.training import dataset_processor, open_demonstrations

NAME = "local/openspm_tabletop"


def processor_of(root: Path, **options) -> DatasetProcessor:
    config = OpenSPMConfig(device="cpu", push_to_hub=False, **options)
    return dataset_processor(LeRobotDatasetMetadata(NAME, root=root), config)


@pytest.fixture(scope="module")
def mining(tiny_dataset: Path) -> DatasetProcessor:
    return processor_of(tiny_dataset)


@pytest.fixture(scope="module")
def mined(mining: DatasetProcessor) -> MinedKeyPoses:
    return mining.key_poses()


def plain(key_poses) -> list[tuple]:
    return [tuple(np.asarray(value).tolist() for value in vars(pose).values()) for pose in key_poses]


def test_reading_it_gives_what_was_mined_and_mines_nothing(
    mined: MinedKeyPoses, annotated_dataset: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delattr(processor, "find_key_poses")
    read = processor_of(annotated_dataset).key_poses()
    assert [item.episode.index for item in read.episodes] == list(range(6))
    for before, after in zip(mined.episodes, read.episodes, strict=True):
        assert plain(before.key_poses) == plain(after.key_poses)


def test_nobody_is_asked_about_phases_that_stand_there(annotated_dataset: Path):
    judge = JudgeConfig("openai", "http://nowhere.test/v1", "m")
    assert len(processor_of(annotated_dataset, judge=judge).key_poses().episodes) == 6


def test_lerobot_reads_it_with_everything_that_was_there(tiny_dataset: Path, annotated_dataset: Path):
    before, after = (
        LeRobotDataset(NAME, root=root, video_backend="pyav") for root in (tiny_dataset, annotated_dataset)
    )
    added = {*TYPES, TARGET, *language_feature_info()}
    assert set(after.features) - set(before.features) == added
    assert {key: after.features[key] for key in before.features} == before.features
    assert before.meta.stats.keys() == after.meta.stats.keys()
    assert (len(after), after.meta.fps, after.meta.total_tasks) == (len(before), before.meta.fps, 2)
    for index in (0, 200, len(before) - 1):
        one, other = before[index], after[index]
        assert all(np.array_equal(one[key], other[key]) for key in one)
        assert set(other) - set(one) == added
    assert not list(annotated_dataset.parent.glob(f".{annotated_dataset.name}*"))


def test_its_videos_are_the_datasets_own_files(tiny_dataset: Path, annotated_dataset: Path):
    videos = [path.relative_to(tiny_dataset) for path in tiny_dataset.rglob("*.mp4")]
    assert videos
    assert all(os.path.samefile(tiny_dataset / video, annotated_dataset / video) for video in videos)
    cameras = "meta/openspm_cameras.json"
    assert (annotated_dataset / cameras).read_bytes() == (tiny_dataset / cameras).read_bytes()
    assert not os.path.samefile(tiny_dataset / cameras, annotated_dataset / cameras), (
        "what may be edited is copied"
    )


def test_neither_hidden_files_nor_pictures_that_became_videos_are_copied(
    tiny_dataset: Path, mined: MinedKeyPoses, tmp_path: Path
):
    root = Path(shutil.copytree(tiny_dataset, tmp_path / "dataset"))
    for name in ("images", ".cache"):
        (root / name).mkdir()
        (root / name / "left").write_bytes(b"x")
    (root / "meta").chmod(0o555)
    write_annotated(processor_of(root).demonstrations, mined, tmp_path / "out")
    taken = {path.name for path in tiny_dataset.iterdir() if not path.name.startswith(".")}
    assert {path.name for path in (tmp_path / "out").iterdir()} == taken
    assert stat.S_IMODE((tmp_path / "out" / "meta").stat().st_mode) & stat.S_IWUSR


def test_where_there_are_no_links_there_are_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_):
        raise OSError("another disk")

    monkeypatch.setattr(os, "link", refuse)
    source, target = tmp_path / "source.mp4", tmp_path / "target.mp4"
    source.write_bytes(b"moving pictures")
    annotate._copy(str(source), str(target))
    assert target.read_bytes() == b"moving pictures"


def test_its_sub_tasks_say_the_phases_to_lerobots_tools(annotated_dataset: Path):
    dataset = LeRobotDataset(NAME, root=annotated_dataset, video_backend="pyav")
    columns = dataset.hf_dataset.select_columns([PHASE, KEY_POSE, IS_KEY_POSE, "timestamp"]).with_format(
        "arrow"
    )
    for record in iter_episodes(annotated_dataset):
        first = int(dataset.meta.episodes["dataset_from_index"][record.episode_index])
        frames = columns[first : first + record.row_count].to_pydict()
        rows = dataset.hf_dataset[first]["language_persistent"]
        spans = reconstruct_subtask_spans(rows, episode_end_t=record.frame_timestamps[-1])
        assert spans[0]["start"] == 0.0
        for time_s, phase in zip(frames["timestamp"], frames[PHASE], strict=True):
            said = [span["text"] for span in spans if span["start"] <= time_s][-1]
            assert not phase or phase in phases_of(said), f"{phase} is called {said!r}"
        assert sum(frames[IS_KEY_POSE]) == max(frames[KEY_POSE]) + 1


def test_held_out_episodes_are_annotated_and_those_without_key_poses_skipped(
    mining: DatasetProcessor, mined: MinedKeyPoses, tmp_path: Path
):
    folder, items = tmp_path / "copy", mined.episodes
    some = replace(mined, episodes=(items[1], items[4]), held_out=items[2:4], skipped={0: "", 5: ""})
    (tmp_path / ".copy.partial").mkdir()  # of a run that was killed
    write_annotated(mining.demonstrations, some, folder)
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]
    everything = processor_of(folder).key_poses()
    assert [item.episode.index for item in everything.episodes] == [1, 2, 3, 4]
    assert sorted(everything.skipped) == [0, 5]
    again = processor_of(folder, memory_episodes=[1, 4]).key_poses(held_out=True)
    assert [item.episode.index for item in again.episodes] == [1, 4]
    assert [item.episode.index for item in again.held_out] == [2, 3]


def test_a_dataset_of_pictures_masks_and_depths_is_annotated_too(tmp_path: Path):
    image_dataset(tmp_path / "data")
    meta = LeRobotDatasetMetadata("local/layers", root=tmp_path / "data")
    demonstrations = open_demonstrations(meta, OpenSPMConfig(device="cpu", push_to_hub=False))
    (episode,) = demonstrations.episodes()
    pose = KeyPose(1, episode.T_world_ee[1], "push", 1.0, False, float(episode.opening[1]), 1, False, 0)
    item = MinedEpisode(episode, (pose,), parse_instruction(episode.task))
    write_annotated(demonstrations, MinedKeyPoses("", robot(), (item,), (), {}), tmp_path / "copy")
    before, after = (LeRobotDataset("local/layers", root=tmp_path / name) for name in ("data", "copy"))
    for index in range(2):
        assert all(np.array_equal(before[index][key], after[index][key]) for key in before[index])
    assert [after[i][IS_KEY_POSE].item() for i in range(2)] == [False, True]


def test_what_was_annotated_before_stays(tiny_dataset: Path, mined: MinedKeyPoses, tmp_path: Path):
    source = tmp_path / "source"
    shutil.copytree(tiny_dataset, source)
    records = list(iter_episodes(source))
    row = {"role": "assistant", "camera": None, "tool_calls": None}
    rows = [
        {**row, "content": "fetch it", "style": "subtask", "timestamp": 0.0},
        {**row, "content": "first this, then that", "style": "plan", "timestamp": 0.0},
        speech_atom(records[1].frame_timestamps[7], "on my way"),
    ]
    EpisodeStaging(tmp_path / "staging", 1).write("plan", rows)
    LanguageColumnsWriter().write_all(records, tmp_path / "staging", source)
    info = load_info(source)
    info.features = {**info.features, **language_feature_info()}
    write_info(info, source)

    theirs = processor_of(source)
    write_annotated(theirs.demonstrations, mined, tmp_path / "copy")
    demonstrations = processor_of(tmp_path / "copy").demonstrations
    assert demonstrations.subtask_rows(1) == [(0.0, "fetch it")]
    assert demonstrations.subtask_rows(2) == []
    assert demonstrations.has_key_poses
    frames = demonstrations.dataset.hf_dataset
    first = demonstrations.episodes([1])[0].from_index
    assert [r["content"] for r in frames[first]["language_persistent"] if r["style"] == "plan"] == [
        "first this, then that"
    ]
    said = [bool(frames[first + i]["language_events"]) for i in range(10)]
    assert said == [i == 7 for i in range(10)]
    (event,) = frames[first + 7]["language_events"]
    assert event["tool_calls"][0]["function"]["arguments"] == {"text": "on my way"}


@pytest.mark.parametrize("fault", [OSError("no space left"), KeyboardInterrupt()])
def test_a_write_that_is_interrupted_leaves_nothing(
    mining: DatasetProcessor, mined: MinedKeyPoses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault
):
    def half(_demonstrations, _mined, root: Path):
        assert (root / "data").is_dir()
        raise fault

    monkeypatch.setattr(annotate, "_write_columns", half)
    with pytest.raises(type(fault)):
        write_annotated(mining.demonstrations, mined, tmp_path / "out/copy")
    assert list((tmp_path / "out").iterdir()) == []


def test_what_cannot_be_written_is_said_before(
    mining: DatasetProcessor,
    mined: MinedKeyPoses,
    tiny_dataset: Path,
    annotated_dataset: Path,
    tmp_path: Path,
):
    with pytest.raises(DatasetError, match="exists already; choose another --annotated"):
        write_annotated(mining.demonstrations, mined, tmp_path)
    with pytest.raises(DatasetError, match="lies in the folder of dataset"):
        write_annotated(mining.demonstrations, mined, tiny_dataset / "annotated")
    again = processor_of(annotated_dataset)
    with pytest.raises(DatasetError, match=r"has the columns openspm\.phase, .* already; mine the dataset"):
        write_annotated(again.demonstrations, mined, tmp_path / "twice")
    assert list(tmp_path.iterdir()) == []
