"""A Hub on 127.0.0.1 for tests: what huggingface_hub, datasets and LeRobot ask of huggingface.co, over real HTTP.

It knows repositories, commits, branches, tags, LFS uploads, resumed downloads, tokens, and can fail on purpose.
`python tests/hub/hub_stand_in.py` runs one until it is interrupted. Clients need HF_ENDPOINT, any HF_TOKEN and
HF_HUB_DISABLE_XET=1.
"""

from __future__ import annotations

import base64
import json
import re
import socket
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from hub_repositories import File, Hub, Repository

USER = "someone"
LFS_SUFFIXES = (".parquet", ".safetensors", ".mp4", ".png", ".jpg", ".bin")


class HubError(Exception):
    """An answer other than 200."""

    def __init__(self, status: int, code: str, message: str) -> None:
        self.status, self.code, self.message = status, code, message


class DroppedError(Exception):
    """The connection is to be cut."""


Reply = tuple[int, dict[str, str], bytes]
REPO = r"(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)"
ROUTES: list[tuple[str, str, str]] = [
    ("GET", r"/api/whoami-v2", "whoami"),
    ("POST", r"/api/validate-yaml", "validate_yaml"),
    ("POST", r"/api/repos/create", "create_repository"),
    ("POST", rf"/api/{REPO}/preupload/(?P<revision>[^/]+)", "preupload"),
    ("POST", rf"/api/{REPO}/commit/(?P<revision>[^/]+)", "commit"),
    ("POST", rf"/api/{REPO}/branch/(?P<branch>[^/]+)", "create_branch"),
    ("POST", rf"/api/{REPO}/tag/(?P<revision>[^/]+)", "create_tag"),
    ("DELETE", rf"/api/{REPO}/tag/(?P<tag>[^/]+)", "delete_tag"),
    ("GET", rf"/api/{REPO}", "info"),
    ("GET", rf"/api/{REPO}/revision/(?P<revision>[^/]+)", "info"),
    ("GET", rf"/api/{REPO}/refs", "refs"),
    ("GET", rf"/api/{REPO}/tree/(?P<revision>[^/]+)(?:/(?P<path>.*))?", "list_tree"),
    ("POST", rf"/api/{REPO}/paths-info/(?P<revision>[^/]+)", "paths_info"),
    ("POST", r"/(?P<prefix>datasets/)?(?P<name>[^/]+/[^/]+)\.git/info/lfs/objects/batch", "lfs_batch"),
    ("PUT", rf"/lfs/{REPO}/(?P<oid>[0-9a-f]{{64}})", "lfs_put"),
    ("POST", rf"/lfs/{REPO}/verify", "lfs_verify"),
    ("GET", r"/(?P<prefix>datasets/)?(?P<name>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)", "resolve"),
]


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def handle_request(self) -> None:
        """Find the route and answer."""
        url = urlsplit(self.path)
        self.query = parse_qs(url.query)
        self.hub.requests.append(f"{self.command} {url.path}")
        method = "GET" if self.command == "HEAD" else self.command
        faults = self.hub.faults
        if faults.is_silent:
            while faults is self.hub.faults:
                time.sleep(0.05)
            self.close_connection = True
            return
        try:
            if faults.answer is not None:
                status, headers, body = faults.answer[0], {"Content-Type": "text/html"}, faults.answer[1]
            else:
                status, headers, body = self._route(method, url.path)
        except HubError as error:
            body = json.dumps({"error": error.message}).encode()
            headers = {"X-Error-Code": error.code, "X-Error-Message": error.message}
            status = error.status
        except DroppedError:
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)
            return
        self._read()
        self.send_response(status)
        for name, value in (
            {"Content-Type": "application/json", "Content-Length": str(len(body))} | headers
        ).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = handle_request  # noqa: N815

    def _route(self, method: str, path: str) -> Reply:
        for wanted, pattern, name in ROUTES:
            match = re.fullmatch(pattern, path)
            if method == wanted and match:
                arguments = {key: unquote(value) for key, value in match.groupdict().items() if value is not None}
                if "prefix" in match.groupdict():
                    arguments["kind"] = "datasets" if arguments.pop("prefix", None) else "models"
                handler: Callable[..., Reply] = getattr(self, f"_{name}")
                return handler(**arguments)
        raise HubError(404, "NotFound", f"no route for {method} {path}")

    # Bodies, tokens, repositories -------------------------------------------------------------------------

    _unread = True

    def parse_request(self) -> bool:
        """Begin a new request."""
        self._unread = True
        return super().parse_request()

    def _read(self) -> bytes:
        """The body, once."""
        if not self._unread:
            return b""
        self._unread = False
        if self.headers.get("Transfer-Encoding", "") == "chunked":
            chunks = []
            while size := int(self.rfile.readline().strip(), 16):
                chunks.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(chunks)
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def _check_token(self, write: bool) -> None:
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        if self.hub.faults.refuse_tokens and token:
            raise HubError(401, "", "Invalid credentials in Authorization header")
        if write and not token:
            raise HubError(401, "", "Invalid username or password.")
        if write and self.hub.faults.read_only_tokens:
            raise HubError(403, "", "Forbidden: you must use a token with write access")

    def _repository(self, kind: str, name: str, write: bool = False) -> Repository:
        self._check_token(write)
        repository = self.hub.repositories.get((kind, name))
        hidden = repository is not None and repository.private and not self.headers.get("Authorization")
        if repository is None or hidden:
            raise HubError(404, "RepoNotFound", "Repository not found")
        return repository

    def _commit_of(self, repository: Repository, revision: str):
        commit = repository.find(revision)
        if commit is None:
            raise HubError(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return commit

    @staticmethod
    def _json(content: Any, status: int = 200) -> Reply:
        return status, {}, json.dumps(content).encode()

    # Accounts and repositories ----------------------------------------------------------------------------

    def _whoami(self) -> Reply:
        self._check_token(write=True)
        return self._json({"type": "user", "name": USER, "orgs": [], "auth": {"accessToken": {"role": "write"}}})

    def _validate_yaml(self) -> Reply:
        return self._json({"errors": [], "warnings": []})

    def _create_repository(self) -> Reply:
        self._check_token(write=True)
        body = json.loads(self._read())
        kind = f"{body.get('type') or 'model'}s"
        name = f"{body.get('organization') or USER}/{body['name']}"
        url = f"{self.hub.url}/{'datasets/' if kind == 'datasets' else ''}{name}"
        with self.hub.lock:
            if (kind, name) in self.hub.repositories:
                return self._json({"error": "You already created this repo", "url": url}, 409)
            private = bool(body.get("private")) or body.get("visibility") == "private"
            self.hub.repositories[kind, name] = Repository(kind, name, private)
        return self._json({"url": url, "name": name, "id": "1"})

    def _create_branch(self, kind: str, name: str, branch: str) -> Reply:
        repository = self._repository(kind, name, write=True)
        start = json.loads(self._read() or b"{}").get("startingPoint") or "main"
        if branch in repository.branches:
            return self._json({"error": "Reference already exists"}, 409)
        repository.branches[branch] = self._commit_of(repository, start).oid
        return self._json({})

    def _create_tag(self, kind: str, name: str, revision: str) -> Reply:
        repository = self._repository(kind, name, write=True)
        tag = json.loads(self._read())["tag"]
        if tag in repository.tags:
            return self._json({"error": "Tag reference exists already"}, 409)
        repository.tags[tag] = self._commit_of(repository, revision).oid
        return self._json({})

    def _delete_tag(self, kind: str, name: str, tag: str) -> Reply:
        repository = self._repository(kind, name, write=True)
        self._commit_of(repository, repository.tags.pop(tag, tag))
        return self._json({})

    def _info(self, kind: str, name: str, revision: str = "main") -> Reply:
        repository = self._repository(kind, name)
        commit = self._commit_of(repository, revision)
        siblings = [{"rfilename": path} for path in sorted(commit.files)]
        return self._json({
            "id": name, "_id": "1", "sha": commit.oid, "private": repository.private, "siblings": siblings,
            "lastModified": commit.date, "createdAt": commit.date, "tags": [], "downloads": 0, "likes": 0,
            "disabled": False, "gated": False,
        })  # fmt: skip

    def _refs(self, kind: str, name: str) -> Reply:
        repository = self._repository(kind, name)
        listed = {
            group: [
                {"name": ref, "ref": f"refs/{prefix}/{ref}", "targetCommit": oid}
                for ref, oid in references.items()
            ]
            for group, prefix, references in (
                ("branches", "heads", repository.branches),
                ("tags", "tags", repository.tags),
            )
        }
        return self._json(listed | {"converts": []})

    # Uploads ----------------------------------------------------------------------------------------------

    def _preupload(self, kind: str, name: str, revision: str) -> Reply:
        repository = self._repository(kind, name, write=True)
        files = self._commit_of(repository, revision).files
        answers = []
        for file in json.loads(self._read())["files"]:
            mode = "lfs" if file["path"].endswith(LFS_SUFFIXES) else "regular"
            answer = {"path": file["path"], "uploadMode": mode, "shouldIgnore": False}
            there = files.get(file["path"])
            answers.append(answer | ({} if there is None else {"oid": there.etag}))
        return self._json({"files": answers})

    def _lfs_batch(self, kind: str, name: str) -> Reply:
        stored = self._repository(kind, name, write=True).lfs
        base = f"{self.hub.url}/lfs/{kind}/{name}"
        objects = []
        for item in json.loads(self._read())["objects"]:
            answer = {"oid": item["oid"], "size": item["size"]}
            if item["oid"] not in stored:
                upload = {"href": f"{base}/{item['oid']}", "header": {}}
                verify = {"href": f"{base}/verify", "header": {}}
                answer["actions"] = {"upload": upload, "verify": verify}
            objects.append(answer)
        return self._json({"transfer": "basic", "objects": objects})

    def _lfs_put(self, kind: str, name: str, oid: str) -> Reply:
        stored = self.hub.repositories[kind, name].lfs
        suffix = self.hub.faults.drop_uploads_of
        length = int(self.headers.get("Content-Length", 0))
        if suffix is not None:
            start = self.rfile.read(min(4, length))
            magic = {".parquet": b"PAR1", ".mp4": b"\0\0\0", ".png": b"\x89PNG"}[suffix]
            if start.startswith(magic):
                self.rfile.read(length // 2)
                raise DroppedError
            self._unread = False
            stored[oid] = start + self.rfile.read(length - len(start))
        else:
            stored[oid] = self._read()
        return self._json({})

    def _lfs_verify(self, kind: str, name: str) -> Reply:
        item = json.loads(self._read())
        if len(self.hub.repositories[kind, name].lfs.get(item["oid"], b"")) != item["size"]:
            raise HubError(400, "", f"LFS object {item['oid']} is not there")
        return self._json({})

    def _commit(self, kind: str, name: str, revision: str) -> Reply:
        if self.hub.faults.drop_commits > 0:
            self.hub.faults.drop_commits -= 1
            raise DroppedError
        repository = self._repository(kind, name, write=True)
        self._commit_of(repository, revision)
        added: dict[str, File] = {}
        deleted: list[str] = []
        message, parent = "", None
        for line in self._read().splitlines():
            item = json.loads(line)
            value = item["value"]
            if item["key"] == "header":
                message, parent = value["summary"], value.get("parentCommit")
            elif item["key"] == "file":
                added[value["path"]] = File(base64.b64decode(value["content"]), is_lfs=False)
            elif item["key"] == "lfsFile":
                if value["oid"] not in repository.lfs:
                    raise HubError(400, "", f"LFS object of {value['path']} was not uploaded")
                added[value["path"]] = File(repository.lfs[value["oid"]], is_lfs=True)
            else:
                deleted.append(value["path"])
        with self.hub.lock:
            if parent not in (None, self._commit_of(repository, revision).oid):
                raise HubError(412, "", "A commit has happened since. Please refresh and try again.")
            commit = repository.commit(revision, message, added, deleted)
        url = f"{self.hub.url}/{'datasets/' if kind == 'datasets' else ''}{name}/commit/{commit.oid}"
        return self._json({"commitOid": commit.oid, "commitUrl": url, "success": True, "hookOutput": ""})

    # Downloads --------------------------------------------------------------------------------------------

    @staticmethod
    def _entry(path: str, file: File) -> dict[str, Any]:
        entry = {"type": "file", "path": path, "size": len(file.content), "oid": file.blob_id}
        if file.is_lfs:
            entry["lfs"] = {"oid": file.sha256, "size": len(file.content), "pointerSize": 134}
        return entry

    def _list_tree(self, kind: str, name: str, revision: str, path: str = "") -> Reply:
        files = self._commit_of(self._repository(kind, name), revision).files
        prefix = f"{path.strip('/')}/" if path.strip("/") else ""
        inside = {name: file for name, file in files.items() if name.startswith(prefix)}
        if prefix and not inside:
            raise HubError(404, "EntryNotFound", f"{path} does not exist")
        recursive = self.query.get("recursive", [""])[0].lower() in ("true", "1")
        entries, folders = [], set()
        for name_, file in sorted(inside.items()):
            parts = name_[len(prefix) :].split("/")
            folders |= {prefix + "/".join(parts[: i + 1]) for i in range(len(parts) - 1)}
            if recursive or len(parts) == 1:
                entries.append(self._entry(name_, file))
        kept = [f for f in sorted(folders) if recursive or "/" not in f[len(prefix) :]]
        entries += [{"type": "directory", "path": folder, "oid": "0" * 40, "size": 0} for folder in kept]
        return self._json(entries)

    def _paths_info(self, kind: str, name: str, revision: str) -> Reply:
        files = self._commit_of(self._repository(kind, name), revision).files
        body = self._read()
        if "json" in self.headers.get("Content-Type", ""):
            paths = json.loads(body)["paths"]
        else:
            paths = parse_qs(body.decode()).get("paths", [])
        entries = []
        for path in paths:
            if path in files:
                entries.append(self._entry(path, files[path]))
            elif any(other.startswith(f"{path}/") for other in files):
                entries.append({"type": "directory", "path": path, "oid": "0" * 40, "size": 0})
        return self._json(entries)

    def _resolve(self, kind: str, name: str, revision: str, path: str) -> Reply:
        commit = self._commit_of(self._repository(kind, name), revision)
        file = commit.files.get(path)
        if file is None:
            raise HubError(404, "EntryNotFound", f"{path} does not exist")
        suffix = self.hub.faults.drop_downloads_of
        if suffix is not None and path.endswith(suffix):
            raise DroppedError
        headers = {
            "ETag": f'"{file.etag}"',
            "X-Repo-Commit": commit.oid,
            "Accept-Ranges": "bytes",
            "Content-Type": "application/octet-stream",
        }
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if not asked:
            return 200, headers, file.content
        start, end = int(asked[1]), int(asked[2] or len(file.content) - 1)
        headers["Content-Range"] = f"bytes {start}-{end}/{len(file.content)}"
        return 206, headers, file.content[start : end + 1]


def serve(port: int = 0) -> tuple[Hub, ThreadingHTTPServer]:
    """Start a Hub in threads of this process; `shutdown()` of the server ends it."""
    hub = Hub()
    handler = type("BoundHandler", (Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", port), handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return hub, server


if __name__ == "__main__":
    running, _ = serve()
    print(f"export HF_ENDPOINT={running.url} HF_TOKEN=any HF_HUB_DISABLE_XET=1", flush=True)
    threading.Event().wait()
