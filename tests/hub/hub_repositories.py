"""What the Hub stand-in keeps, in memory: files by commit, branches and tags, and what it is to do wrong."""

from __future__ import annotations

import hashlib
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

TIME_FORMAT = "%Y-%m-%dT%H:%M:%S.000Z"


@dataclass(frozen=True)
class File:
    """A file of a commit."""

    content: bytes
    is_lfs: bool

    @property
    def blob_id(self) -> str:
        """Git's name of it."""
        return hashlib.sha1(b"blob %d\0" % len(self.content) + self.content).hexdigest()

    @property
    def sha256(self) -> str:
        """The LFS name of it."""
        return hashlib.sha256(self.content).hexdigest()

    @property
    def etag(self) -> str:
        """What the Hub answers as the file's ETag."""
        return self.sha256 if self.is_lfs else self.blob_id


@dataclass(frozen=True)
class Commit:
    """A state of a repository."""

    oid: str
    message: str
    files: dict[str, File]
    parents: tuple[str, ...] = ()
    date: str = field(default_factory=lambda: time.strftime(TIME_FORMAT, time.gmtime()))


class Repository:
    """A model or dataset repository."""

    def __init__(self, kind: str, name: str, private: bool = False) -> None:
        self.kind, self.name, self.private = kind, name, private
        self.commits: dict[str, Commit] = {}
        self.branches: dict[str, str] = {}
        self.tags: dict[str, str] = {}
        self.lfs: dict[str, bytes] = {}
        """Uploads by sha256, committed or not."""
        self.commit("main", "initial commit", {".gitattributes": File(b"*.parquet filter=lfs\n", False)}, [])

    def find(self, revision: str) -> Commit | None:
        """The commit of a branch, a tag or an oid."""
        oid = self.branches.get(revision) or self.tags.get(revision) or revision
        return self.commits.get(oid)

    def commit(self, branch: str, message: str, added: dict[str, File], deleted: list[str]) -> Commit:
        """Add a commit to a branch."""
        parent = self.find(branch)
        files = dict(parent.files) if parent else {}
        for path in deleted:
            files = {
                name: file for name, file in files.items() if name != path and not name.startswith(f"{path}/")
            }
        files |= added
        parents = (parent.oid,) if parent else ()
        digest = hashlib.sha1(f"{self.kind}/{self.name}/{message}/{time.time_ns()}".encode())
        commit = Commit(digest.hexdigest(), message, files, parents)
        self.commits[commit.oid] = commit
        self.branches[branch] = commit.oid
        return commit

    def commit_folder(self, folder: Path, branch: str = "main") -> Commit:
        """Add a commit with the files of a folder, as if they had been pushed."""
        paths = [path for path in folder.rglob("*") if path.is_file()]
        added = {str(path.relative_to(folder)): File(path.read_bytes(), is_lfs=False) for path in paths}
        return self.commit(branch, f"Add {folder.name}", added, [])


@dataclass
class Faults:
    """What goes wrong; tests set it."""

    refuse_tokens: bool = False
    read_only_tokens: bool = False
    drop_uploads_of: str | None = None
    """LFS uploads of files with this suffix lose their connection after half of the bytes."""
    drop_downloads_of: str | None = None
    """Downloads of files with this suffix lose their connection."""
    drop_commits: int = 0
    """So many commits lose their connection before they are read."""
    answer: tuple[int, bytes] | None = None
    """Status and body of the answer to every request."""
    is_silent: bool = False
    """Requests are taken and never answered."""


@dataclass
class Hub:
    """Everything that the server keeps."""

    url: str = ""
    repositories: dict[tuple[str, str], Repository] = field(default_factory=dict)
    faults: Faults = field(default_factory=Faults)
    requests: list[str] = field(default_factory=list)
    """Method and path of every request, for tests that ask what was transferred."""
    lock: threading.RLock = field(default_factory=threading.RLock)

    def tree(self, kind: str, name: str, revision: str = "main") -> dict[str, bytes]:
        """Files of a repository, without the Hub's own `.gitattributes`."""
        commit = self.repositories[kind, name].find(revision)
        assert commit is not None
        return {path: file.content for path, file in commit.files.items() if path != ".gitattributes"}
