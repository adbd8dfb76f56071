"""A policy that cannot be loaded, in `cronos-eval`."""

import sys

import pytest
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.evaluation import runner
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


def test_what_is_not_installed_is_one_line(tmp_path, monkeypatch):
    def make(*args, **kwargs):
        raise ImportError("'peft' is required but not installed.\nInstall it with: pip install 'lerobot[peft]'")

    policy = save_policy(tmp_path / "policy", "pocketvla", STATE, hidden_width=16, hidden_depth=1)
    monkeypatch.setattr(runner, "load_actor", make)
    flags = [f"--policy.path={policy}", f"--output_dir={tmp_path / 'out'}", "--quick=true"]
    monkeypatch.setattr(sys, "argv", ["cronos-eval", "--env.obs_type=environment_state_agent_pos", *flags])
    with pytest.raises(SystemExit, match=r"^error: 'peft' is required but not installed\. Install it with: pip "):
        script.main()
