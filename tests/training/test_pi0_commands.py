"""`cronos-train` and LeRobot's evaluation of tiny pi0 and pi0.5 in LeRobot's own format."""

import json
import os
import sys
from pathlib import Path

import pytest
from forked_commands import run_forked
from runs import metrics
from test_adapters import VLA_FLAGS, paid_for_moving  # noqa: F401
from test_cronos_train import OBSERVATIONS, cronos_train, moved
from tiny_checkpoints import save_policy
from tiny_pi0 import save_tiny_tokenizer, tiny_gemma, tokenizer_from, use_tokenizer

SIZES = {"chunk_size": 6, "n_action_steps": 5, "num_inference_steps": 3, "image_resolution": (28, 28)}
PIXELS = {"observation_height": 64, "observation_width": 64}
EVALUATE = """
import sys
sys.modules["cronos_lerobot"] = None
from tiny_pi0 import tiny_gemma
from lerobot.scripts.lerobot_eval import main
with tiny_gemma():
    main()
"""


@pytest.mark.usefixtures("paid_for_moving")
@pytest.mark.parametrize("kind", ["pi0", "pi05"])
def test_it_learns_from_pixels_and_is_a_lerobot_policy(kind, tmp_path, monkeypatch):
    tokenizer, run = tmp_path / "tokenizer", tmp_path / "run"
    save_tiny_tokenizer(tokenizer)
    with tiny_gemma(), tokenizer_from(tokenizer):
        clone = save_policy(tmp_path / "clone", kind, PIXELS, **SIZES)
    use_tokenizer(clone, tokenizer)
    flags = (f"--policy.path={clone}", *VLA_FLAGS, "--steps=40", f"--output_dir={run}")
    with tiny_gemma():
        cronos_train(monkeypatch, *flags)
    updates = [line["agent"] for line in metrics(run, "update")]
    assert len(updates) == 2
    assert all(update["policy_grad_norm"] > 0 for update in updates)
    first, last = (run / f"checkpoints/{name}/pretrained_model" for name in ("000020", "last"))
    names = moved(first, last)
    assert [name for name in names if "gemma_expert" in name]
    assert [name for name in names if "vision_tower" in name]

    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    command = [
        sys.executable, "-c", EVALUATE, f"--policy.path={last}", "--policy.device=cpu",
        "--env.type=cronos", *OBSERVATIONS["pixels"], "--env.render_size=[32, 32]",
        "--env.task=put the ketchup bottle on the cloth", "--eval.n_episodes=1", "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'out'}",
    ]  # fmt: skip
    done = run_forked(command, env=os.environ | {"PYTHONPATH": path})
    assert done.returncode == 0, done.stderr[-3000:]
    info = json.loads((tmp_path / "out/eval_info.json").read_text())
    assert len(info["per_task"][0]["metrics"]["sum_rewards"]) == 1
