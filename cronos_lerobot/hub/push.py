"""Pushes a folder to the Hub, and says in one sentence what went wrong."""

from __future__ import annotations

import sys
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from glob import escape
from json import JSONDecodeError
from pathlib import Path

import httpx
from huggingface_hub import HfApi, constants, get_session, set_client_factory
from huggingface_hub.errors import (
    HfHubHTTPError,
    LocalEntryNotFoundError,
    LocalTokenNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.utils import disable_progress_bars

TIMEOUT_S = 60.0
"""Seconds that the Hub may take to answer, or to take the next bytes of an upload."""
AGAIN = "run the same command again, it resumes with what is missing"
UNREADABLE = (JSONDecodeError, KeyError, TypeError, AttributeError, httpx.DecodingError)
"""What huggingface_hub raises at an answer that no Hub gives, such as a proxy's login page."""


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


def limit_waiting() -> None:
    """Let requests to the Hub fail after `TIMEOUT_S` without an answer; huggingface_hub waits for ever."""
    hooks = [hook for hook in get_session().event_hooks["request"] if hook is not _limit]
    set_client_factory(
        lambda: httpx.Client(event_hooks={"request": [*hooks, _limit]}, follow_redirects=True, timeout=None)
    )


def _limit(request: httpx.Request) -> None:
    # Most requests of huggingface_hub ask for no limit, whatever the client's own is.
    given = request.extensions.get("timeout") or {}
    names = ("connect", "read", "write", "pool")
    request.extensions["timeout"] = {name: given.get(name) or TIMEOUT_S for name in names}


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
        replaces: patterns of files that are removed if the folder does not have them. One without a slash is of
            files at the root alone.
        tag: to put onto the result, moved if it is there.
        creates: make the repository if it is not there.
        parent_commit: that the branch must still be at, because the tree was made from it.

    Returns:
        The URL of the repository.

    Raises:
        PublishError: the Hub refused, the branch is at another commit than `parent_commit`, or the connection was
            lost; pushing again resumes with what is missing.
    """
    if not sys.stderr.isatty():
        disable_progress_bars()
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
            delete_patterns=[escape(file) for file in matching(there, replaces)] or None,
            parent_commit=parent_commit,
        )
        if tag:
            with suppress(RevisionNotFoundError):
                api.delete_tag(repo_id, repo_type=kind, tag=tag)
            api.create_tag(repo_id, repo_type=kind, tag=tag, revision=target.branch)
    return target.url


def matching(files: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Return the files that patterns name; the `*` of a pattern without a slash passes no folder."""
    return [
        file
        for file in files
        if any(fnmatchcase(file, pattern) and ("/" in pattern or "/" not in file) for pattern in patterns)
    ]


def check_holds(target: Target, known_by: Sequence[str], advice: str) -> None:
    """Check that a repository is new, has no more than a card, or is known to be what is pushed again.

    Args:
        target: the repository.
        known_by: patterns of files; the repository must have one of them.
        advice: what to do if it has none, for the error.

    Raises:
        PublishError: it holds something else, which a push would overwrite, or the Hub refused.
    """
    api = HfApi()
    with explained(target):
        if not api.repo_exists(target.repo_id, repo_type=target.repo_type):
            return
        files = api.list_repo_files(target.repo_id, repo_type=target.repo_type)
    there = sorted(set(files) - {".gitattributes", "README.md"})
    if there and not matching(there, known_by):
        raise PublishError(
            f"{target.repo_type} {target.repo_id} holds something else ({', '.join(there[:3])}, ...): {advice}"
        )


@contextmanager
def explained(target: Target) -> Generator[None]:
    """Turn what the Hub's client raises into a PublishError."""
    try:
        yield
    except Exception as error:
        if (why := _explain(error, target)) is None:
            raise
        raise PublishError(" ".join(why.split())) from error


def _explain(error: BaseException, target: Target) -> str | None:
    where, hub = f"{target.repo_type} {target.repo_id}", constants.ENDPOINT
    if isinstance(error, RevisionNotFoundError):
        return f"{where} has no revision {target.revision or target.branch or 'main'!r} on {hub}"
    if isinstance(error, LocalTokenNotFoundError):
        return f"there is no token for {hub}: set HF_TOKEN, or run `hf auth login`"
    status = error.response.status_code if isinstance(error, HfHubHTTPError) and error.response is not None else 0
    if isinstance(error, RepositoryNotFoundError) and status != 401:
        return f"there is no {where} on {hub}, or the token gives no access to it"
    refusals = {
        401: f"{hub} refused the token, or there is none: set HF_TOKEN, or run `hf auth login`",
        403: f"the token may not write to {where} on {hub}",
        412: f"{where} on {hub} was changed meanwhile, nothing was pushed: run the same command again",
        429: f"{hub} asks for fewer requests (429 Too Many Requests): wait some minutes, then {AGAIN}",
    }
    if status >= 500:
        return f"{hub} has a fault of its own ({status}) and did not take {where}: wait, then {AGAIN}"
    if status >= 400:
        return refusals.get(status) or f"{hub} refused {where} ({status}): {str(error)[:300]}"
    if isinstance(error, httpx.TimeoutException):
        return f"{hub} did not answer in time ({type(error).__name__}) about {where}: {AGAIN}"
    if isinstance(error, UNREADABLE):
        why = f"gave an answer that is none of a Hub's ({type(error).__name__})"
        return f"{hub} {why} about {where}: check HF_ENDPOINT and your proxy"
    if isinstance(error, httpx.HTTPError | LocalEntryNotFoundError):
        return f"lost the connection to {hub} ({type(error).__name__}) about {where}: {AGAIN}"
    # An upload in a thread is reported with its cause.
    return _explain(error.__cause__, target) if isinstance(error, RuntimeError) and error.__cause__ else None
