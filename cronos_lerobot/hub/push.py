"""Pushes a folder to the Hub, and says in one sentence what went wrong."""

from __future__ import annotations

import sys
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from glob import escape
from json import JSONDecodeError
from pathlib import Path
from typing import Any

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

from cronos_lerobot.hub.config import PublishConfig

TIMEOUT_S = 60.0
"""Seconds that the Hub may take to answer, or to take the next bytes of an upload."""
AGAIN = "run the same command again, it resumes with what is missing"
LOG_IN = "set HF_TOKEN, or run `hf auth login`"
ADVICE = {
    401: LOG_IN,
    403: "the token may not write there",
    412: "it was changed meanwhile and nothing was pushed: run the same command again",
    429: f"it asks for fewer requests: wait some minutes, then {AGAIN}",
}
"""What helps, by the status of the Hub's answer."""
UNREADABLE = (JSONDecodeError, KeyError, TypeError, AttributeError, httpx.DecodingError)
"""What huggingface_hub raises at an answer that no Hub gives, such as a proxy's login page."""


class PublishError(Exception):
    """Publishing failed; the message says why and what helps."""


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
    config: PublishConfig,
    repo_type: str,
    message: str,
    *,
    replaces: Sequence[str] = (),
    tag: str | None = None,
    parent_commit: str | None = None,
) -> str:
    """Make the repository what `folder` is; files that are there already are not sent again. Returns its URL.

    Args:
        folder: the tree to push.
        config: where to.
        repo_type: `dataset` or `model`.
        message: of the commit.
        replaces: patterns (see `matching`) of files that are removed if the folder does not have them.
        tag: to put onto the result, moved if it is there.
        parent_commit: that the branch must still be at. None makes a repository that is not there.

    Raises:
        PublishError: the Hub refused, or the connection was lost; pushing again resumes with what is missing.
    """
    if not sys.stderr.isatty():
        disable_progress_bars()
    api, branch = HfApi(), config.branch
    where: Any = {"repo_id": config.repo_id, "repo_type": repo_type}
    with explained(**where):
        if parent_commit is None:
            api.create_repo(**where, private=config.private, exist_ok=True)
        if branch:
            api.create_branch(**where, branch=branch, revision=config.revision, exist_ok=True)
        there = api.list_repo_files(**where, revision=branch) if replaces else []
        api.upload_folder(
            **where,
            folder_path=folder,
            revision=branch,
            commit_message=message,
            delete_patterns=[escape(file) for file in matching(there, replaces)] or None,
            parent_commit=parent_commit,
        )
        if tag:
            with suppress(RevisionNotFoundError):
                api.delete_tag(**where, tag=tag)
            api.create_tag(**where, tag=tag, revision=branch)
    page = f"{constants.ENDPOINT}/{'datasets/' if repo_type == 'dataset' else ''}{config.repo_id}"
    return f"{page}/tree/{branch}" if branch else page


def matching(files: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Return the files that patterns name; the `*` of a pattern without a slash passes no folder."""
    return [
        file
        for file in files
        if any(fnmatchcase(file, pattern) and ("/" in pattern or "/" not in file) for pattern in patterns)
    ]


def check_holds(repo_id: str, repo_type: str, known_by: Sequence[str], advice: str) -> None:
    """Check that a repository is new, has no more than a card, or is known to be what is pushed again.

    Args:
        repo_id: its name.
        repo_type: `dataset` or `model`.
        known_by: patterns of files; the repository must have one of them.
        advice: what to do if it has none, for the error.

    Raises:
        PublishError: it holds something else, which a push would overwrite, or the Hub refused.
    """
    api = HfApi()
    with explained(repo_id, repo_type):
        is_there = api.repo_exists(repo_id, repo_type=repo_type)
        files = api.list_repo_files(repo_id, repo_type=repo_type) if is_there else []
    others = sorted(set(files) - {".gitattributes", "README.md"})
    if others and not matching(others, known_by):
        raise PublishError(f"{repo_type} {repo_id} holds something else ({', '.join(others[:3])}, ...): {advice}")


@contextmanager
def explained(repo_id: str, repo_type: str = "model") -> Generator[None]:
    """Turn what the Hub's client raises about a repository into a PublishError."""
    try:
        yield
    except Exception as error:
        if (why := _explain(error)) is None:
            raise
        raise PublishError(f"{repo_type} {repo_id} on {constants.ENDPOINT}: {' '.join(why.split())}") from error


def _explain(error: BaseException) -> str | None:
    """What an error of the Hub's client means and what helps; None if it is another kind of error."""
    kind = type(error).__name__
    status = error.response.status_code if isinstance(error, HfHubHTTPError) and error.response is not None else 0
    if isinstance(error, LocalTokenNotFoundError):
        return f"there is no token: {LOG_IN}"
    if isinstance(error, RevisionNotFoundError):
        return "it has no such revision: see --branch and --revision"
    if isinstance(error, RepositoryNotFoundError) and status != 401:
        return "it is not there, or the token gives no access to it"
    if status >= 400:
        other = f"the Hub has a fault of its own: wait, then {AGAIN}" if status >= 500 else f"{error}"[:300]
        return f"refused with status {status}: {ADVICE.get(status, other)}"
    if isinstance(error, httpx.TimeoutException):
        return f"the Hub did not answer in time ({kind}): {AGAIN}"
    if isinstance(error, UNREADABLE):
        return f"the answer is none of a Hub's ({kind}): check HF_ENDPOINT and your proxy"
    if isinstance(error, httpx.HTTPError | LocalEntryNotFoundError):
        return f"lost the connection ({kind}): {AGAIN}"
    # An upload in a thread is reported with its cause.
    return _explain(error.__cause__) if isinstance(error, RuntimeError) and error.__cause__ else None
