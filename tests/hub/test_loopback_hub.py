import json
import subprocess
import sys
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file
from tests.hub.loopback_hub import LoopbackHub

REPO = "someone/openspm-test"


def run(hub: LoopbackHub, home: Path, code: str, *, offline: bool = False) -> Any:
    """Run code in a process for which `hub` is the Hub; return the JSON of its last line."""
    done = subprocess.run(
        [sys.executable, "-c", dedent(code)],
        env=hub.env(home, offline=offline),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def push(hub: LoopbackHub, home: Path, folder: Path) -> dict[str, str]:
    return run(
        hub,
        home,
        f"""
        import json
        from huggingface_hub import HfApi
        api = HfApi()
        repo = api.create_repo({REPO!r}, private=True, exist_ok=True)
        done = api.upload_folder(repo_id=repo.repo_id, folder_path={str(folder)!r}, commit_message="a policy",
                                 allow_patterns=["*.safetensors", "*.json", "*.md"])
        print(json.dumps({{"repo_id": repo.repo_id, "oid": done.oid, "url": done.repo_url.url}}))
        """,
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "policy"
    (folder / "bank").mkdir(parents=True)
    (folder / "config.json").write_text('{"type": "openspm"}')
    (folder / "README.md").write_text("---\nlicense: apache-2.0\n---\n# A policy\n")
    (folder / "notes.txt").write_text("not among the allowed patterns")
    save_file({"weight": np.arange(3000, dtype=np.float32)}, folder / "bank" / "bank.safetensors")
    return folder


def test_push_then_pull_then_pull_offline(loopback_hub: LoopbackHub, folder: Path, tmp_path: Path):
    pushed = push(loopback_hub, tmp_path / "home_a", folder)
    assert pushed["repo_id"] == REPO
    assert pushed["url"] == f"{loopback_hub.endpoint}/{REPO}"
    sent = ["README.md", "bank/bank.safetensors", "config.json"]
    assert sorted(loopback_hub.files(REPO)) == sent

    pull = f"""
        import json
        from pathlib import Path
        from huggingface_hub import hf_hub_download, snapshot_download
        folder = Path(snapshot_download({REPO!r}))
        one = hf_hub_download({REPO!r}, "config.json")
        files = {{str(p.relative_to(folder)): p.read_bytes().hex() for p in folder.rglob("*") if p.is_file()}}
        print(json.dumps({{"commit": folder.name, "files": files, "one": Path(one).read_text()}}))
    """
    home = tmp_path / "home_b"
    pulled = run(loopback_hub, home, pull)
    assert pulled["commit"] == pushed["oid"]
    assert pulled["one"] == '{"type": "openspm"}'
    assert {name: bytes.fromhex(hexa) for name, hexa in pulled["files"].items()} == {
        name: (folder / name).read_bytes() for name in sent
    }

    before = len(loopback_hub.requests)
    assert run(loopback_hub, home, pull, offline=True) == pulled
    assert len(loopback_hub.requests) == before


def test_a_second_push_sends_only_what_changed(loopback_hub: LoopbackHub, folder: Path, tmp_path: Path):
    first = push(loopback_hub, tmp_path / "home", folder)
    assert push(loopback_hub, tmp_path / "home", folder)["oid"] == first["oid"]
    (folder / "config.json").write_text('{"type": "openspm", "n_steps": 5}')
    assert push(loopback_hub, tmp_path / "home", folder)["oid"] != first["oid"]
    assert json.loads(loopback_hub.files(REPO)["config.json"])["n_steps"] == 5


def test_what_is_missing_raises_the_clients_own_errors(
    loopback_hub: LoopbackHub, folder: Path, tmp_path: Path
):
    push(loopback_hub, tmp_path / "home", folder)
    errors = run(
        loopback_hub,
        tmp_path / "home",
        f"""
        import json
        from huggingface_hub import HfApi, file_exists, hf_hub_download
        def name_of(call, *args, **kwargs):
            try:
                call(*args, **kwargs)
            except Exception as error:
                return type(error).__name__
        print(json.dumps([
            name_of(hf_hub_download, {REPO!r}, "model.safetensors"),
            name_of(hf_hub_download, {REPO!r}, "config.json", revision="v9"),
            name_of(hf_hub_download, "someone/else", "config.json"),
            name_of(HfApi().model_info, "someone/else"),
            [file_exists({REPO!r}, "config.json"), file_exists({REPO!r}, "nothing.json")],
        ]))
        """,
    )
    assert errors == [
        "RemoteEntryNotFoundError",
        "RevisionNotFoundError",
        "RepositoryNotFoundError",
        "RepositoryNotFoundError",
        [True, False],
    ]
