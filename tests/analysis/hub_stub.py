"""A hub on this machine: the few endpoints of the Hugging Face hub that an upload and a download speak."""

import base64
import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

TOKEN = "hf_writes"


def commit(files: dict[str, bytes]) -> str:
    """The name of what a repository holds: no two states have one."""
    return hashlib.sha1(repr(sorted(files.items())).encode()).hexdigest()


class Hub(ThreadingHTTPServer):
    """Keeps repositories in memory. ``asked`` are the requests so far, ``large`` what was uploaded as a large file."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Requests)
        self.repos: dict[str, dict[str, bytes]] = {}
        self.private: set[str] = set()
        self.asked: list[str] = []
        self.large: dict[str, bytes] = {}
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def environment(self, home: Path) -> dict[str, str]:
        """Of a process that speaks with it; large files go the way of git-lfs, not through hf-xet."""
        return {"HF_ENDPOINT": self.url, "HF_HOME": str(home), "HF_TOKEN": TOKEN, "HF_HUB_DISABLE_XET": "1"}

    def close(self) -> None:
        self.shutdown()
        self.server_close()


class _Requests(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, *_: Any) -> None:
        """To nobody."""

    def do_POST(self) -> None:
        body, path = self._body(), self.path.partition("?")[0]
        if path == "/api/validate-yaml":
            fault = [{"message": '"license" must be one of these'}] * ("license: foo" in json.loads(body)["content"])
            return self._json({"errors": fault, "warnings": []}, 400 if fault else 200)
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self._refuse(401, "")
        if path == "/api/repos/create":
            return self._create(json.loads(body))
        if path.endswith(".git/info/lfs/objects/batch"):
            return self._json(
                {"transfer": "basic", "objects": [self._upload(item) for item in json.loads(body)["objects"]]}
            )
        _, _, _, owner, name, action, _ = path.split("/")
        if action == "preupload":
            files = [self._mode(item["path"]) for item in json.loads(body)["files"]]
            return self._json({"files": files})
        assert action == "commit"
        return self._commit(f"{owner}/{name}", [json.loads(line) for line in body.splitlines()])

    def do_PUT(self) -> None:
        body, oid = self._body(), self.path.rpartition("/")[2]
        assert hashlib.sha256(body).hexdigest() == oid
        self.server.large[oid] = body
        self._json({})

    def do_HEAD(self) -> None:
        self._file()

    def do_GET(self) -> None:
        self._file()

    def _create(self, wanted: dict[str, Any]) -> None:
        repo = f"{wanted['organization']}/{wanted['name']}"
        if wanted["organization"] == "others":
            return self._refuse(403, "")
        there = repo in self.server.repos
        self.server.repos.setdefault(repo, {})
        if wanted.get("visibility") == "private":
            self.server.private.add(repo)
        return self._json({"url": f"{self.server.url}/{repo}"}, 409 if there else 200)

    def _mode(self, path: str) -> dict[str, Any]:
        large = path.endswith(".safetensors")
        return {"path": path, "uploadMode": "lfs" if large else "regular", "shouldIgnore": False}

    def _upload(self, item: dict[str, Any]) -> dict[str, Any]:
        return {**item, "actions": {"upload": {"href": f"{self.server.url}/large/{item['oid']}"}}}

    def _commit(self, repo: str, lines: list[dict[str, Any]]) -> None:
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                self.server.repos[repo][value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                self.server.repos[repo][value["path"]] = self.server.large[value["oid"]]
        name = commit(self.server.repos[repo])
        self._json({"success": True, "commitOid": name, "commitUrl": f"{self.server.url}/{repo}/commit/{name}"})

    def _file(self) -> None:
        self._note()
        owner, name, *rest = self.path.strip("/").removeprefix("api/models/").split("/")
        files = self.server.repos.get(f"{owner}/{name}")
        if files is None:
            return self._refuse(403, "GatedRepo") if owner == "gated" else self._refuse(404, "RepoNotFound")
        if not rest:
            return self._json({"id": f"{owner}/{name}"})
        resolve, revision, file = rest
        assert resolve == "resolve"
        if revision not in ("main", commit(files)):
            return self._refuse(404, "RevisionNotFound")
        if file not in files:
            return self._refuse(404, "EntryNotFound")
        etag = hashlib.sha256(files[file]).hexdigest()
        return self._send(200, files[file], {"ETag": f'"{etag}"', "X-Repo-Commit": commit(files)})

    def _body(self) -> bytes:
        self._note()
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def _note(self) -> None:
        self.server.asked.append(f"{self.command} {self.path}")

    def _json(self, answer: dict[str, Any], status: int = 200) -> None:
        self._send(status, json.dumps(answer).encode(), {"Content-Type": "application/json"})

    def _refuse(self, status: int, code: str) -> None:
        self._send(status, b"{}", {"X-Error-Code": code} if code else {})

    def _send(self, status: int, body: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in (headers | {"Content-Length": str(len(body))}).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)
