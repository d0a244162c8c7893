"""A stand-in of the Hub's API in this process: a repository, large files by LFS, commits, tags, downloads."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self, override
from urllib.parse import unquote, urlsplit

_LARGE = 1000
"""Files from this size are large ones [bytes]."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    @override
    def handle_error(self, *arguments: object) -> None:
        """Killed clients are no news."""


class Hub:
    """The server; a context manager.

    Attributes:
        files: path -> content, of the newest commit of its one repository; None before it is created.
        tags: tag -> commit.
        blobs: sha256 -> content of a large file that has arrived.
        uploads: sha256 -> how often it was uploaded.
        downloads: path -> how often it was downloaded.
        commits: number of commits.
        hold: called with the kind and name of each transfer, of which half has happened; returns whether to go on.
    """

    def __init__(self, token: str) -> None:
        self.token = token
        self.files: dict[str, bytes] | None = None
        self.tags: dict[str, str] = {}
        self.blobs: dict[str, bytes] = {}
        self.uploads: Counter[str] = Counter()
        self.downloads: Counter[str] = Counter()
        self.commits = 0
        self.hold: Callable[[str, str], bool] = lambda kind, name: True
        hub = self

        class Handler(_Handler):
            def __init__(self, *arguments: Any) -> None:
                self.hub = hub
                super().__init__(*arguments)

        self._server = _Server(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, name="hub", daemon=True)
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @property
    def commit(self) -> str:
        return f"{self.commits:040x}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, *arguments: object) -> None:
        pass

    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.headers.get("Authorization") != f"Bearer {self.hub.token}":
            self._answer({"error": "Invalid username or password."}, 401)
            return
        path = unquote(urlsplit(self.path).path)
        for pattern, act in _POSTS.items():
            if found := re.fullmatch(pattern, path):
                act(self, content, *found.groups())
                return
        self._answer({"error": path}, 404)

    def do_PUT(self) -> None:
        sha = self.path.rpartition("/")[2]
        length = int(self.headers["Content-Length"])
        content = self.rfile.read(length // 2)
        if not self.hub.hold("upload", sha):
            self.close_connection = True
            return
        content += self.rfile.read(length - len(content))
        if hashlib.sha256(content).hexdigest() == sha:
            self.hub.blobs[sha] = content
            self.hub.uploads[sha] += 1
        self._answer({})

    def do_DELETE(self) -> None:
        self.hub.tags.pop(unquote(self.path).rpartition("/")[2], None)
        self._answer({})

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        files = self.hub.files
        if files is None:
            self.send_response(404)
            self.send_header("X-Error-Code", "RepoNotFound")
            self.send_header("Content-Length", "0")
            self.end_headers()
        elif found := re.fullmatch(r"/datasets/me/pick/resolve/[^/]+/(.*)", path):
            self._download(found[1], files[found[1]])
        elif "/tree/" in path:
            self._answer(
                [{"type": "file", "path": name, "size": len(each), "oid": "0"} for name, each in files.items()]
            )
        elif path.endswith("/refs"):
            tags = [{"name": tag, "ref": f"refs/tags/{tag}", "targetCommit": at} for tag, at in self.hub.tags.items()]
            self._answer({"branches": [], "converts": [], "tags": tags})
        else:
            siblings = [{"rfilename": name} for name in files]
            self._answer({"id": "me/pick", "sha": self.hub.commit, "siblings": siblings})

    def _download(self, name: str, content: bytes) -> None:
        self.send_response(200)
        self.send_header("ETag", f'"{hashlib.sha256(content).hexdigest()}"')
        self.send_header("X-Repo-Commit", self.hub.commit)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command == "HEAD":
            return
        self.hub.downloads[name] += 1
        middle = len(content) // 2
        self.wfile.write(content[:middle])
        self.wfile.flush()
        if self.hub.hold("download", name):
            self.wfile.write(content[middle:])
        else:
            self.close_connection = True

    def _create(self, content: bytes) -> None:
        self.hub.files = self.hub.files or {}
        self._answer({"url": f"{self.hub.url}/datasets/me/pick", "id": "me/pick", "name": "me/pick"})

    def _preupload(self, content: bytes) -> None:
        files = [
            {"path": each["path"], "uploadMode": "lfs" if each["size"] >= _LARGE else "regular", "shouldIgnore": False}
            for each in json.loads(content)["files"]
        ]
        self._answer({"files": files})

    def _batch(self, content: bytes) -> None:
        objects = []
        for each in json.loads(content)["objects"]:
            upload = {"upload": {"href": f"{self.hub.url}/blobs/{each['oid']}"}}
            objects.append({**each, **({} if each["oid"] in self.hub.blobs else {"actions": upload})})
        self._answer({"objects": objects, "transfer": "basic"})

    def _commit(self, content: bytes) -> None:
        assert self.hub.files is not None
        for line in map(json.loads, content.splitlines()):
            value = line["value"]
            match line["key"]:
                case "file":
                    self.hub.files[value["path"]] = base64.b64decode(value["content"])
                case "lfsFile":
                    self.hub.files[value["path"]] = self.hub.blobs[value["oid"]]
                case "deletedFile":
                    del self.hub.files[value["path"]]
        self.hub.commits += 1
        url = f"{self.hub.url}/datasets/me/pick/commit/{self.hub.commit}"
        self._answer({"success": True, "commitOid": self.hub.commit, "commitUrl": url, "hookOutput": ""})

    def _tag(self, content: bytes, revision: str) -> None:
        self.hub.tags[json.loads(content)["tag"]] = revision
        self._answer({})

    def _answer(self, content: Any, status: int = 200) -> None:
        encoded = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(encoded)))
        self.end_headers()
        self.wfile.write(encoded)


_POSTS: Mapping[str, Callable[..., None]] = {
    r"/api/repos/create": _Handler._create,
    r"/api/validate-yaml": lambda handler, _: handler._answer({"errors": [], "warnings": []}),
    r"/api/datasets/me/pick/preupload/main": _Handler._preupload,
    r"/datasets/me/pick.git/info/lfs/objects/batch": _Handler._batch,
    r"/api/datasets/me/pick/commit/main": _Handler._commit,
    r"/api/datasets/me/pick/tag/(\w+)": _Handler._tag,
}
