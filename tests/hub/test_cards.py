"""Cards are public: no folder of whoever made them is on one."""

import shlex

import pytest

from cronos_lerobot.hub.cards import command_line, without_folders


@pytest.mark.parametrize(
    ("word", "shown"),
    [
        ("--output_dir=/scratch/me/runs/eer", "--output_dir=.../eer"),
        ("--dataset.root=/mnt/my data/demos/", "--dataset.root=.../demos"),
        ("/scratch/me/eer", ".../eer"),
        ("--env.benchmark=/data/bench@v1", "--env.benchmark=.../bench@v1"),
        ("--x=['/a/b c/d', \"/e/f\"]", "--x=['.../d', \".../f\"]"),
        ("--x={a: /secret/b, c: [/d/e,/f/g]}", "--x={a: .../b, c: [.../e,.../g]}"),
        ("algorithm.demos.root=/a/b, then /a/c", "algorithm.demos.root=.../b, then .../c"),
        ("--output_dir=/home/me/eer", "--output_dir=~/eer"),
        ("--x=['/home/me', '/home/me/a']", "--x=['~', '~/a']"),
        ("--output_dir=/home/melanie/eer", "--output_dir=.../eer"),
        ("--output_dir=/mnt/home/me/eer", "--output_dir=.../eer"),
    ],
)
def test_absolute_paths_are_shortened(monkeypatch, word, shown):
    monkeypatch.setenv("HOME", "/home/me")
    assert without_folders(word) == shown


@pytest.mark.parametrize(
    "word",
    ["--output_dir=outputs/train/eer", "--x=./a/b", "--x=~/a", "--policy.path=me/clone", "--x=https://a.org/b/c",
     "--ratio=1/2", "--x=[a/b, c/d]", "--filter='put the spoon / knife away'"],
)  # fmt: skip
def test_everything_else_stays(word):
    assert without_folders(word) == word


def test_a_shell_reads_the_command_as_it_is_shown():
    words = ["cronos-train", "--output_dir=/scratch/my runs/a b", "--policy.path=me/clone"]
    text = command_line(words)
    assert text == "cronos-train \\\n    '--output_dir=.../a b' \\\n    --policy.path=me/clone"
    assert shlex.split(text.replace("\\\n", ""))[1:] == ["--output_dir=.../a b", "--policy.path=me/clone"]
