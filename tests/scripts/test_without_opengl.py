"""Commands that draw, where nothing can be drawn."""

import sys

import pytest
from lerobot_env_cronos.simulation import rendering

from cronos_lerobot.scripts import publish, record_demos


@pytest.mark.parametrize(
    ("script", "flags", "folder", "advice"),
    [
        (
            record_demos,
            "--env.type=cronos --env.num_threads=1 --num_envs=1 --dataset.repo_id=me/d",
            "dataset.root",
            "",
        ),
        (publish, "benchmark --repo_id=me/d --dry_run=true", "output_dir", "--pictures=false publishes without"),
    ],
)
def test_it_is_told_in_one_line_before_anything_is_made(script, flags, folder, advice, tmp_path, monkeypatch):
    def fail(*_):
        raise ImportError("EGL")

    monkeypatch.setattr(rendering, "Canvas", fail)
    monkeypatch.setattr(sys, "argv", ["command", *flags.split(), f"--{folder}={tmp_path / 'out'}"])
    with pytest.raises(SystemExit, match=rf"^error: cannot open an OpenGL context.*{advice}"):
        script.main()
    assert not (tmp_path / "out").exists()


def test_demonstrations_from_the_state_need_none(tmp_path, monkeypatch):
    def fail(*_):
        raise ImportError("EGL")

    monkeypatch.setattr(rendering, "Canvas", fail)
    flags = (
        "--env.type=cronos --env.num_threads=1 --env.obs_type=environment_state_agent_pos --num_envs=1"
        " --dataset.repo_id=me/d --dataset.num_episodes=1"
    )
    monkeypatch.setattr(sys, "argv", ["command", *flags.split(), f"--dataset.root={tmp_path / 'out'}"])
    record_demos.main()
    assert (tmp_path / "out/meta/info.json").is_file()
