"""Whatever keeps weights from being loaded is one error that says what to do."""

import json
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path

import pytest
from tests.hub.loopback_hub import LoopbackHub, Repo
from tests.perception.segmentation import tiny_models

from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.pretrained import fetch
from lerobot_openspm.perception.segmentation.pretrained import load as load_pretrained
from lerobot_openspm.perception.segmentation.sam3 import Sam3Segmenter

# Loads each of the named weights in a process of its own: huggingface_hub reads at import where the Hub is.
LOAD = """
import json, sys, time
from lerobot_openspm.errors import PerceptionError
from lerobot_openspm.perception.segmentation.sam3 import Sam3Segmenter
import transformers
told = {}
for name in sys.argv[1:]:
    start = time.monotonic()
    try:
        Sam3Segmenter.from_pretrained(name)
        told[name] = ["loaded", "", time.monotonic() - start]
    except PerceptionError as error:
        causes, cause = [], error.__cause__
        while cause is not None:
            causes.append(type(cause).__name__)
            cause = cause.__cause__ or cause.__context__
        told[name] = [str(error), " ".join(causes), time.monotonic() - start]
print(json.dumps(told))
"""
# What a person waits at most before being told what is wrong.
SECONDS = 15.0
INCLUDE = "--include '*.json' --include '*.txt' --include '*.safetensors'"


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A checkpoint of SAM 3 with its processor."""
    folder = tmp_path_factory.mktemp("sam3")
    tiny = tiny_models.sam3()
    tiny.model.save_pretrained(folder)
    tiny.processor.save_pretrained(folder)
    return folder


def load(env: dict[str, str], *names: str) -> dict[str, list]:
    """What loading each name says, the causes' types, and how long it took."""
    done = subprocess.run(
        [sys.executable, "-c", LOAD, *names],
        env=env | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    late = {name: row for name, row in told.items() if row[0] != "loaded" and row[2] >= SECONDS}
    assert not late
    return told


def publish(hub: LoopbackHub, name: str, folder: Path) -> None:
    hub.repos["models", name] = Repo()
    hub.repos["models", name].commit({path.name: path.read_bytes() for path in folder.iterdir()}, "weights")


@dataclass(frozen=True)
class Visit:
    """What one process was told by the Hub about several names, and the cache that it left."""

    told: dict[str, list]
    gated: dict[str, HTTPStatus]
    requests: list[str]
    home: Path


@pytest.fixture(scope="module")
def visit(saved: Path, tmp_path_factory: pytest.TempPathFactory) -> Visit:
    """Each process imports transformers first, so one asks for everything. Nobody may change its cache."""
    home = tmp_path_factory.mktemp("home")
    with LoopbackHub().running() as hub:
        for name in ("tester/sam3", "tester/half", "tester/asked", "tester/denied", "tester/bare"):
            publish(hub, name, saved)
        hub.gated = {"tester/asked": HTTPStatus.UNAUTHORIZED, "tester/denied": HTTPStatus.FORBIDDEN}
        tree = hub.files("tester/bare")
        tree["pytorch_model.bin"] = tree.pop("model.safetensors")
        told = load(hub.env(home), *(name for _, name in hub.repos), "tester/nowhere")
    return Visit(told, hub.gated, hub.requests, home)


@pytest.fixture
def home(visit: Visit, tmp_path: Path) -> Path:
    """A copy of the cache that was left, to change and to use."""
    return Path(shutil.copytree(visit.home, tmp_path / "home", symlinks=True))


@pytest.mark.slow
def test_weights_come_from_the_hub_or_say_why_not(visit: Visit):
    told = visit.told
    assert told["tester/sam3"][0] == told["tester/half"][0] == "loaded"
    for name in visit.gated:
        assert f"access at https://huggingface.co/{name}, then" in told[name][0]
        assert told[name][0].endswith("hf auth login")
        assert "GatedRepoError" in told[name][1]
    assert "no model 'tester/nowhere' on the Hugging Face Hub that you may see" in told["tester/nowhere"][0]
    assert "RepositoryNotFoundError" in told["tester/nowhere"][1]
    assert "'tester/bare' is no checkpoint of Sam3Model" in told["tester/bare"][0]
    assert not [request for request in visit.requests if request.endswith("pytorch_model.bin")]


@pytest.mark.slow
def test_offline_what_is_in_the_cache_is_loaded(loopback_hub: LoopbackHub, home: Path):
    (half,) = home.glob("hub/models--tester--half/snapshots/*/model.safetensors")
    half.unlink()
    told = load(loopback_hub.env(home, offline=True), "tester/sam3", "tester/half", "tester/none")
    assert told["tester/sam3"][0] == "loaded"
    for name in ("tester/half", "tester/none"):
        message, causes, _ = told[name]
        assert message.startswith(f"{name!r} is not or not wholly in the cache, and HF_HUB_OFFLINE forbids")
        assert message.endswith(f"HF_HUB_OFFLINE=0 hf download {name} {INCLUDE}")
        assert "OfflineModeIsEnabled" in causes


@pytest.mark.slow
def test_no_network_ends_within_seconds(loopback_hub: LoopbackHub, home: Path):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        # Bound but not listening: every connection is refused.
        port = closed.getsockname()[1]
        env = loopback_hub.env(home) | {"HF_ENDPOINT": f"http://127.0.0.1:{port}"}
        told = load(env, "facebook/sam3", "tester/sam3")
    message, causes, _ = told["facebook/sam3"]
    assert "'facebook/sam3' is not or not wholly in the cache, and the Hugging Face Hub cannot be" in message
    assert message.endswith(f"with a network: hf download facebook/sam3 {INCLUDE}")
    assert "ConnectError" in causes
    assert told["tester/sam3"][0] == "loaded"


def test_without_transformers_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    message = r"needs transformers: .*pip install 'lerobot_policy_openspm\[perception\]'"
    with pytest.raises(PerceptionError, match=message) as caught:
        Sam3Segmenter.from_pretrained()
    assert isinstance(caught.value.__cause__, ImportError)


def test_a_transformers_without_the_model_says_how_to_bring_it_up_to_date():
    with pytest.raises(PerceptionError, match=r"transformers 5\S+ has no Sam9Model: .*\[perception\]'"):
        fetch("facebook/sam9", "Sam9Model", "cpu")


def test_a_device_that_is_not_there_is_named_before_anything_is_downloaded():
    start = time.monotonic()
    with pytest.raises(PerceptionError, match=r"device 'warp' cannot be used: .*Use 'cpu'"):
        Sam3Segmenter.from_pretrained("tester/never", "warp")
    assert time.monotonic() - start < SECONDS


@pytest.fixture
def copy(saved: Path, tmp_path: Path) -> Path:
    """A checkpoint to spoil."""
    for path in saved.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def remove(name: str):
    return lambda folder: (folder / name).unlink()


def truncate(name: str):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-100])


@pytest.mark.parametrize(
    "spoil",
    [
        remove("config.json"),
        remove("model.safetensors"),
        truncate("config.json"),
        truncate("model.safetensors"),
        lambda folder: (folder / "model.safetensors").rename(folder / "pytorch_model.bin"),
    ],
    ids=["no config", "no weights", "config cut short", "weights cut short", "weights by pickle"],
)
def test_a_folder_that_is_no_checkpoint_is_named(copy: Path, spoil):
    spoil(copy)
    with pytest.raises(PerceptionError, match=r"'/.*' is no checkpoint of Sam3Model: .*Give the name"):
        load_pretrained(str(copy), "Sam3Model", "Sam3Processor", "cpu")


@pytest.mark.parametrize("spoil", [remove("tokenizer.json"), truncate("processor_config.json")])
def test_a_folder_without_a_processor_is_named(copy: Path, spoil):
    spoil(copy)
    with pytest.raises(PerceptionError, match=r"'/.*' is no checkpoint of Sam3Processor: "):
        load_pretrained(str(copy), "Sam3Model", "Sam3Processor", "cpu")


@pytest.mark.parametrize("name", ["/nowhere/at/all", "not a name", ""])
def test_what_is_neither_a_folder_nor_a_name_is_refused(name: str):
    with pytest.raises(PerceptionError, match=f"'{name}' is no checkpoint of Sam3Model"):
        fetch(name, "Sam3Model", "cpu")
