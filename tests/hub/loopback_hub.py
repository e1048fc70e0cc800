"""A Hugging Face Hub on 127.0.0.1, in memory, for tests that push and pull with huggingface_hub itself.

It speaks what `HfApi.create_repo`, `upload_folder`, `repo_info`, `list_repo_tree`, `hf_hub_download` and
`snapshot_download` ask for. Every file is taken as a regular one (no LFS, no Xet), inline in the commit.

huggingface_hub reads HF_ENDPOINT once, at import, so the code under test runs in a process of its own:

    subprocess.run([sys.executable, "-c", CODE], env=loopback_hub.env(tmp_path), check=True)
"""

import base64
import hashlib
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import unquote, urlsplit

USER = "tester"
TYPES = ("models", "datasets", "spaces")


def git_blob_id(content: bytes) -> str:
    """Return git's name for a file's content; the client compares it with its own to skip unchanged files."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@dataclass
class Repo:
    """The commits of one repository's main branch, oldest first: commit id and the whole tree."""

    commits: list[tuple[str, dict[str, bytes]]] = field(default_factory=list)

    def commit(self, files: dict[str, bytes], summary: str) -> str:
        """Append a commit and return its id."""
        parent = self.commits[-1][0] if self.commits else ""
        listing = json.dumps(
            [len(self.commits), parent, summary, {p: git_blob_id(c) for p, c in files.items()}]
        )
        commit_id = hashlib.sha1(listing.encode()).hexdigest()
        self.commits.append((commit_id, files))
        return commit_id

    def at(self, revision: str) -> tuple[str, dict[str, bytes]] | None:
        """Return commit id and files at `main` or at a commit id."""
        if revision == "main":
            return self.commits[-1]
        return next((commit for commit in self.commits if commit[0] == revision), None)


class HubError(Exception):
    """An answer other than 200, with the code that huggingface_hub makes its exceptions from."""

    def __init__(self, status: HTTPStatus, code: str | None = None, **body: str) -> None:
        super().__init__(code or status.phrase)
        self.status = status
        self.code = code
        self.body = {"error": str(self)} | body


class LoopbackHub:
    """The store and its server.

    `requests` holds "METHOD path" of everything that was asked for; `gated` what is answered to whoever asks
    for a repository's files: 401 without a token, 403 with one that has no access.
    """

    def __init__(self) -> None:
        self.repos: dict[tuple[str, str], Repo] = {}
        self.gated: dict[str, HTTPStatus] = {}
        self.requests: list[str] = []
        self.lock = threading.Lock()
        handler = type("Handler", (_Handler,), {"hub": self})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"

    @contextmanager
    def running(self) -> Iterator["LoopbackHub"]:
        """Serve until the block ends."""
        thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True
        )
        thread.start()
        try:
            yield self
        finally:
            self._server.shutdown()
            self._server.server_close()
            thread.join()

    def env(self, home: Path, *, offline: bool = False) -> dict[str, str]:
        """Return a process environment in which this server is the Hub and `home` holds the cache."""
        inherited = {
            key: value for key, value in os.environ.items() if not key.startswith(("HF_", "HUGGING"))
        }
        return inherited | {
            "HF_ENDPOINT": self.endpoint,
            "HF_HOME": str(home),
            "HF_LEROBOT_HOME": str(home / "lerobot"),
            "HF_TOKEN": "hf_dummy",
            "HF_HUB_OFFLINE": "1" if offline else "0",
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_DISABLE_PROGRESS_BARS": "1",
            "NO_PROXY": "127.0.0.1",
            "no_proxy": "127.0.0.1",
        }

    def files(self, repo_id: str, repo_type: str = "model") -> dict[str, bytes]:
        """Return what lies on the main branch of a repository."""
        return self.repos[f"{repo_type}s", repo_id].commits[-1][1]

    def repo(self, kind: str, repo_id: str) -> Repo:
        """Return a repository or raise what the Hub answers when there is none."""
        try:
            return self.repos[kind, repo_id]
        except KeyError:
            raise HubError(HTTPStatus.NOT_FOUND, "RepoNotFound") from None

    def tree(self, kind: str, repo_id: str, revision: str) -> tuple[str, dict[str, bytes]]:
        """Return commit id and files of a repository at a revision."""
        found = self.repo(kind, repo_id).at(revision)
        if found is None:
            raise HubError(HTTPStatus.NOT_FOUND, "RevisionNotFound")
        return found

    # One method per endpoint; the handler below finds it by the path.

    def create(self, body: dict[str, Any]) -> dict[str, Any]:
        """POST /api/repos/create."""
        repo_id = f"{body.get('organization') or USER}/{body['name']}"
        kind = f"{body.get('type') or 'model'}s"
        address = f"{self.endpoint}/{repo_id}" if kind == "models" else f"{self.endpoint}/{kind}/{repo_id}"
        if (kind, repo_id) in self.repos:
            raise HubError(HTTPStatus.CONFLICT, url=address)
        self.repos[kind, repo_id] = Repo()
        self.repos[kind, repo_id].commit({}, "initial commit")
        return {"url": address, "name": repo_id, "id": repo_id}

    def info(self, kind: str, repo_id: str, revision: str) -> dict[str, Any]:
        """GET /api/models/{repo}/revision/{revision}."""
        commit_id, files = self.tree(kind, repo_id, revision)
        siblings = [{"rfilename": path} for path in sorted(files)]
        return {"id": repo_id, "sha": commit_id, "private": False, "tags": [], "siblings": siblings}

    def listing(self, kind: str, repo_id: str, revision: str) -> list[dict[str, Any]]:
        """GET /api/models/{repo}/tree/{revision}."""
        _, files = self.tree(kind, repo_id, revision)
        return [
            {"type": "file", "path": path, "size": len(content), "oid": git_blob_id(content)}
            for path, content in sorted(files.items())
        ]

    def preupload(self, kind: str, repo_id: str, revision: str, body: dict[str, Any]) -> dict[str, Any]:
        """POST /api/models/{repo}/preupload/{revision}."""
        _, present = self.tree(kind, repo_id, revision)
        answers = []
        for entry in body["files"]:
            answer = {"path": entry["path"], "uploadMode": "regular", "shouldIgnore": False}
            if entry["path"] in present:
                answer["oid"] = git_blob_id(present[entry["path"]])
            answers.append(answer)
        return {"files": answers}

    def commit(self, kind: str, repo_id: str, revision: str, lines: list[dict[str, Any]]) -> dict[str, Any]:
        """POST /api/models/{repo}/commit/{revision}, the operations as lines of JSON."""
        if revision != "main":
            raise HubError(HTTPStatus.NOT_FOUND, "RevisionNotFound")
        with self.lock:
            files = dict(self.tree(kind, repo_id, revision)[1])
            summary = ""
            for line in lines:
                value = line["value"]
                match line["key"]:
                    case "header":
                        summary = value["summary"]
                    case "file":
                        files[value["path"]] = base64.b64decode(value["content"])
                    case "deletedFile":
                        files.pop(value["path"], None)
                    case "deletedFolder":
                        prefix = value["path"].rstrip("/") + "/"
                        files = {path: c for path, c in files.items() if not path.startswith(prefix)}
                    case key:
                        raise HubError(HTTPStatus.NOT_IMPLEMENTED, f"commit line {key}")
            commit_id = self.repo(kind, repo_id).commit(files, summary)
        folder = "" if kind == "models" else f"{kind}/"
        url = f"{self.endpoint}/{folder}{repo_id}/commit/{commit_id}"
        return {"success": True, "commitOid": commit_id, "commitUrl": url}


class _Handler(BaseHTTPRequestHandler):
    """Find the endpoint of a request, call it, send what it returns."""

    hub: ClassVar[LoopbackHub]
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: object) -> None:
        """Keep silent; the requests are in `LoopbackHub.requests`."""

    def do_GET(self) -> None:
        self._answer()

    def do_HEAD(self) -> None:
        self._answer()

    def do_POST(self) -> None:
        self._answer()

    def _answer(self) -> None:
        parts = [unquote(part) for part in urlsplit(self.path).path.strip("/").split("/")]
        body = self._body()
        self.hub.requests.append(f"{self.command} /{'/'.join(parts)}")
        try:
            if parts[0] == "api":
                content, headers = json.dumps(self._api(parts[1:], body)).encode(), {}
                headers["Content-Type"] = "application/json"
            else:
                content, headers = self._file(parts)
            self._send(HTTPStatus.OK, content, headers)
        except HubError as error:
            content = json.dumps(error.body).encode()
            headers = {"Content-Type": "application/json", "X-Error-Message": str(error)}
            if error.code is not None:
                headers["X-Error-Code"] = error.code
            self._send(error.status, content, headers)

    def _body(self) -> bytes:
        if "chunked" not in self.headers.get("Transfer-Encoding", ""):
            return self.rfile.read(int(self.headers.get("Content-Length") or 0))
        chunks = []
        while size := int(self.rfile.readline().split(b";")[0], 16):
            chunks.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(chunks)

    def _api(self, parts: list[str], body: bytes) -> object:
        hub = self.hub
        match self.command, parts:
            case "GET", ["whoami-v2"]:
                return {"type": "user", "name": USER, "orgs": []}
            case "POST", ["validate-yaml"]:
                return {"errors": [], "warnings": []}
            case "POST", ["repos", "create"]:
                return hub.create(json.loads(body))
            case "GET", [kind, owner, name] if kind in TYPES:
                return hub.info(kind, f"{owner}/{name}", "main")
            case "GET", [kind, owner, name, "revision", revision] if kind in TYPES:
                return hub.info(kind, f"{owner}/{name}", revision)
            case "GET", [kind, owner, name, "tree", revision] if kind in TYPES:
                return hub.listing(kind, f"{owner}/{name}", revision)
            case "POST", [kind, owner, name, "preupload", revision] if kind in TYPES:
                return hub.preupload(kind, f"{owner}/{name}", revision, json.loads(body))
            case "POST", [kind, owner, name, "commit", revision] if kind in TYPES:
                lines = [json.loads(line) for line in body.splitlines() if line]
                return hub.commit(kind, f"{owner}/{name}", revision, lines)
        raise HubError(HTTPStatus.NOT_FOUND)

    def _file(self, parts: list[str]) -> tuple[bytes, dict[str, str]]:
        kind = parts.pop(0) if parts[0] in TYPES else "models"
        match self.command, parts:
            case (("GET" | "HEAD"), [owner, name, "resolve", revision, *path]):
                commit_id, files = self.hub.tree(kind, f"{owner}/{name}", revision)
                if f"{owner}/{name}" in self.hub.gated:
                    raise HubError(self.hub.gated[f"{owner}/{name}"], "GatedRepo")
                content = files.get("/".join(path))
                if content is None:
                    raise HubError(HTTPStatus.NOT_FOUND, "EntryNotFound")
                return content, {
                    "Content-Type": "application/octet-stream",
                    "ETag": f'"{git_blob_id(content)}"',
                    "X-Repo-Commit": commit_id,
                }
        raise HubError(HTTPStatus.NOT_FOUND)

    def _send(self, status: HTTPStatus, content: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in (headers | {"Content-Length": str(len(content))}).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)
