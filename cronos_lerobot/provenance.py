"""What a result was made with: versions of packages, and the commit of a checkout."""

from __future__ import annotations

import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = (
    "cronos-lerobot", "lerobot_env_cronos", "lerobot_policy_pocketvla", "lerobot", "mujoco", "torch", "numpy",
    "gymnasium",
)  # fmt: skip


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that decide a result, those of them that are installed."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def git_commit() -> str | None:
    """Return the commit of the checkout this package runs from, marked if it was changed, or None."""
    folder = Path(__file__).resolve().parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        # An installed wheel inside someone else's repository is not ours.
        tracked = subprocess.run(
            ["git", "-C", str(folder), "ls-files", "--error-unmatch", __file__], capture_output=True
        )
        if tracked.returncode != 0:
            return None
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
