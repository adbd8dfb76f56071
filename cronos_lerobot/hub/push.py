"""Pushes a folder to the Hub, and says in one sentence what went wrong."""

from __future__ import annotations

import logging
import sys
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from glob import escape
from pathlib import Path

import httpx
from huggingface_hub import HfApi, constants
from huggingface_hub.errors import (
    HfHubHTTPError,
    HFValidationError,
    LocalEntryNotFoundError,
    LocalTokenNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.utils import disable_progress_bars


class PublishError(Exception):
    """Publishing failed; the message says why and what helps."""


@dataclass(frozen=True)
class Target:
    """A place on the Hub."""

    repo_id: str
    repo_type: str
    """`dataset` or `model`."""
    branch: str | None = None
    """Where to push, `main` by default; made if it is not there."""
    revision: str | None = None
    """What a new branch starts from, `main` by default."""
    private: bool | None = None

    @property
    def url(self) -> str:
        """Its page."""
        prefix = "datasets/" if self.repo_type == "dataset" else ""
        branch = f"/tree/{self.branch}" if self.branch else ""
        return f"{constants.ENDPOINT}/{prefix}{self.repo_id}{branch}"


def push_folder(
    folder: Path,
    target: Target,
    message: str,
    *,
    replaces: Sequence[str] = (),
    tag: str | None = None,
    creates: bool = True,
    parent_commit: str | None = None,
) -> str:
    """Make the repository what `folder` is; files that are there already are not sent again.

    Args:
        folder: the tree to push.
        target: where to.
        message: of the commit.
        replaces: patterns of files that are removed where the folder does not have them; one without a folder is
            of files at the root alone.
        tag: to put onto the result, moved if it is there.
        creates: make the repository if it is not there.
        parent_commit: that the branch must still be at, where what is pushed was made from it.

    Returns:
        The URL of the repository.

    Raises:
        PublishError: the Hub refused, the branch is at another commit than `parent_commit`, or the connection was
            lost; pushing again goes on with what is missing.
    """
    if not sys.stderr.isatty():
        disable_progress_bars()
        # The Hub's advice on large folders and its retries: what matters of them is in our errors.
        logging.getLogger("huggingface_hub").setLevel(logging.ERROR)
    api = HfApi()
    repo_id, kind = target.repo_id, target.repo_type
    with explained(target):
        if creates:
            api.create_repo(repo_id, repo_type=kind, private=target.private, exist_ok=True)
        if target.branch:
            api.create_branch(
                repo_id, repo_type=kind, branch=target.branch, revision=target.revision, exist_ok=True
            )
        there = api.list_repo_files(repo_id, repo_type=kind, revision=target.branch) if replaces else []
        api.upload_folder(
            repo_id=repo_id,
            repo_type=kind,
            folder_path=folder,
            revision=target.branch,
            commit_message=message,
            delete_patterns=[escape(file) for file in replaced(there, replaces)] or None,
            parent_commit=parent_commit,
        )
        if tag:
            _move_tag(api, target, tag)
    return target.url


def replaced(there: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Return the files of a repository that patterns name; the `*` of one without a folder passes no folder."""
    return [
        file
        for file in there
        if any(fnmatchcase(file, pattern) and ("/" in pattern or "/" not in file) for pattern in patterns)
    ]


def check_holds(target: Target, known_by: Sequence[str], advice: str) -> None:
    """Check that a repository is new, has no more than a card, or is known to be what is pushed again.

    Args:
        target: the repository.
        known_by: patterns of files; it is if it holds one of them.
        advice: what to do if it is not, for the error.

    Raises:
        PublishError: it holds something else, which a push would overwrite, or the Hub refused.
    """
    api = HfApi()
    with explained(target):
        if not api.repo_exists(target.repo_id, repo_type=target.repo_type):
            return
        files = api.list_repo_files(target.repo_id, repo_type=target.repo_type)
    there = sorted(set(files) - {".gitattributes", "README.md"})
    if there and not replaced(there, known_by):
        raise PublishError(
            f"{target.repo_type} {target.repo_id} holds something else ({', '.join(there[:3])}, ...): {advice}"
        )


def _move_tag(api: HfApi, target: Target, tag: str) -> None:
    with suppress(RevisionNotFoundError):
        api.delete_tag(target.repo_id, repo_type=target.repo_type, tag=tag)
    api.create_tag(target.repo_id, repo_type=target.repo_type, tag=tag, revision=target.branch)


@contextmanager
def explained(target: Target) -> Generator[None]:
    """Turn what the Hub's client raises into a PublishError."""
    try:
        yield
    except Exception as error:
        why = _explain(error, target)
        if why is None:
            raise
        raise PublishError(why) from error


def _explain(error: BaseException, target: Target) -> str | None:
    where, hub = f"{target.repo_type} {target.repo_id}", constants.ENDPOINT
    if isinstance(error, HFValidationError):
        return f"{target.repo_id!r} is no name of a repository, expected <owner>/<name>: {error}"
    if isinstance(error, RevisionNotFoundError):
        return f"{where} has no revision {target.revision or target.branch or 'main'!r} on {hub}"
    if isinstance(error, LocalTokenNotFoundError):
        return f"there is no token for {hub}: set HF_TOKEN, or run `hf auth login`"
    status = getattr(error.response, "status_code", None) if isinstance(error, HfHubHTTPError) else None
    if status == 401:
        return (
            f"{hub} refused the token, or there is none: set HF_TOKEN to one that may write (or `hf auth login`)"
        )
    if isinstance(error, RepositoryNotFoundError):
        return f"there is no {where} on {hub}, or the token gives no access to it"
    if status == 403:
        return f"the token may not write to {where} on {hub}"
    if status == 412:
        return f"{where} on {hub} was changed meanwhile, nothing was pushed: run the same command again"
    if isinstance(error, HfHubHTTPError) and status is not None and status < 500:
        return f"{hub} refused: {error}"
    if isinstance(error, HfHubHTTPError | LocalEntryNotFoundError | httpx.TransportError):
        return (
            f"lost the connection to {hub} ({type(error).__name__}) while pushing to {where}: run the same command"
            " again, it goes on with what is missing"
        )
    # An upload in a thread is reported with its cause.
    return _explain(error.__cause__, target) if isinstance(error, RuntimeError) and error.__cause__ else None
