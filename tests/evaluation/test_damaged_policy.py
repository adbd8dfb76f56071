"""A policy that cannot be loaded, in `cronos-eval`."""

import sys

import pytest
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.scripts import eval as script


@pytest.mark.parametrize("name", ["model.safetensors", "policy_preprocessor.json"])
def test_it_is_told_in_one_line_and_takes_no_folder(name, tmp_path, monkeypatch):
    broken = save_policy(tmp_path / "policy", "pocketvla", STATE, hidden_width=16, hidden_depth=1)
    whole = (broken / name).read_bytes()
    (broken / name).write_bytes(whole[: len(whole) // 2])
    flags = ["--env.obs_type=environment_state_agent_pos", "--eval.n_episodes=1", "--eval.suites=independent"]
    flags += ["--eval.splits=train", "--eval.videos=0", f"--output_dir={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", ["cronos-eval", f"--policy.path={broken}", *flags])
    with pytest.raises(SystemExit, match=rf"^error: .*{broken}.* is damaged: "):
        script.main()
    (broken / name).write_bytes(whole)
    script.main()
    assert len(list(tmp_path.glob("out/parts/*.json"))) == 1
