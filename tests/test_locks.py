"""One writer for a folder, until it gives it back or dies."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cronos_lerobot.locks import FolderInUseError, FolderLock

HOLD = """
import sys
from cronos_lerobot.locks import FolderLock
with FolderLock(sys.argv[1]):
    print("held", flush=True)
    input()
"""


def test_a_second_writer_is_told_who_the_first_one_is(tmp_path):
    folder = tmp_path / "run"
    with FolderLock(folder):
        with pytest.raises(FolderInUseError, match=rf"run is being written by process {os.getpid()} on"):
            FolderLock(folder).acquire()
        FolderLock(tmp_path / "another").acquire().release()
    FolderLock(folder).acquire().release()
    assert not folder.exists()


def test_two_names_of_a_folder_are_one(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "run")
    with FolderLock(tmp_path / "run"), pytest.raises(FolderInUseError):
        FolderLock(tmp_path / "link").acquire()


def test_a_killed_writer_leaves_no_lock(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path / "run")]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
    ) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(FolderInUseError, match=f"process {holder.pid} on"):
            FolderLock(tmp_path / "run").acquire()
        holder.kill()
        holder.wait()
        FolderLock(tmp_path / "run").acquire().release()


def test_where_nothing_can_be_written_beside_a_folder_the_lock_is_in_it(tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    FolderLock(tmp_path / "mine").acquire().release()
    assert (tmp_path / "mine/.lock").is_file()
    # Of a folder that is not there yet there is no inside.
    assert FolderLock(tmp_path / "new").path == tmp_path / ".new.lock"
