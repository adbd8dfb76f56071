"""A resumed run is the unbroken one; what may not change, files of strangers, runs that a budget ended."""

import json
import os
import pickle

import pytest
import torch
from dummies import DummyEnv
from runs import (
    STEPS_PER_UPDATE,
    STREAMS,
    assert_same_run,
    config,
    killed,
    make_trainer,
    metrics,
    resumed,
    train,
)

from cronos_lerobot.agents.ppo.config import PaperPPOConfig, PPOConfig
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.training.checkpoint import read_state
from cronos_lerobot.training.config import PeriodicEvaluationConfig, RecordConfig
from cronos_lerobot.training.reading import check_resumed
from cronos_lerobot.training.run_folder import check_links
from cronos_lerobot.training.trainer import Trainer


def test_a_resumed_run_equals_the_unbroken_one(tmp_path):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    train(config(unbroken))
    killed(config(broken))
    assert (broken / "checkpoints/last").resolve().name == f"{2 * STEPS_PER_UPDATE:06d}"
    # Lines after the checkpoint, also half a line, are what a kill may leave.
    with (broken / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "update", "interaction_steps": 96}\n{"kind": "upd')
    # Everything must come from the checkpoint.
    torch.manual_seed(999)
    train(resumed(broken))
    assert_same_run(unbroken, broken)
    assert len(json.loads((broken / "manifest.json").read_text())["starts"]) == 2


@pytest.mark.parametrize("saved_every", [1, 2, 4])
def test_a_kill_in_an_evaluation_loses_the_evaluation_alone(saved_every, tmp_path, monkeypatch):
    """The one after two updates, and the last one."""
    options = {"save_freq": saved_every * STEPS_PER_UPDATE}
    train(config(tmp_path / "unbroken", **options))
    trainer = make_trainer(config(tmp_path / "broken", **options))
    evaluate = Trainer._evaluate
    for step in (2, 4) if saved_every < 4 else (4,):

        def evaluate_or_die(self, step=step):
            if self.loop.n == step * STEPS_PER_UPDATE:
                raise KeyboardInterrupt
            evaluate(self)

        monkeypatch.setattr(Trainer, "_evaluate", evaluate_or_die)
        with pytest.raises(KeyboardInterrupt):
            trainer.train()
        monkeypatch.setattr(Trainer, "_evaluate", evaluate)
        trainer = make_trainer(resumed(tmp_path / "broken", **options))
        assert trainer.loop.n == step * STEPS_PER_UPDATE
    trainer.train()
    assert metrics(tmp_path / "broken") == metrics(tmp_path / "unbroken")


CHANGED = {
    "--seed": {"seed": 6},
    "--num_envs": {"num_envs": 6},
    "--record.repo_id": {"record": RecordConfig(repo_id="me/stream")},
    "--algorithm.kl_base_coef": {"algorithm": PPOConfig(kl_base_coef=0.2)},
    "--algorithm.type": {"algorithm": PaperPPOConfig()},
    "--protocol.learned_reset": {"protocol": ProtocolConfig(4, 8, 16, learned_reset=True)},
    "--eval.n_episodes": {"eval": PeriodicEvaluationConfig(n_episodes=4, batch_size=5)},
    "--steps": {"steps": 32},
}


def test_what_a_run_must_keep_is_named(tmp_path):
    train(config(tmp_path, steps=2 * STEPS_PER_UPDATE, eval_freq=0))
    state = read_state(tmp_path / "checkpoints/last")
    for flag, options in CHANGED.items():
        with pytest.raises(ValueError, match=flag):
            check_resumed(resumed(tmp_path, **options), state)
    longer = resumed(tmp_path, eval_freq=0)
    longer.protocol.reset_budget = 100
    check_resumed(longer, state)


def test_another_world_is_refused_whatever_release_it_came_with(tmp_path):
    train(config(tmp_path, steps=STEPS_PER_UPDATE, eval_freq=0))
    resume = resumed(tmp_path, steps=2 * STEPS_PER_UPDATE, eval_freq=0)
    path = tmp_path / "checkpoints/last/training_state/state.pt"
    saved = torch.load(path)
    fingerprint = saved["benchmark"]["fingerprint"]
    torch.save(saved | {"benchmark": {"source": "dummies 0.2", "fingerprint": fingerprint}}, path)
    make_trainer(resume)
    others = {"environment": "dummies/line-v2", "benchmark": {"source": "", "fingerprint": "abc"}}
    for name, value in others.items():
        torch.save(saved | {name: value}, path)
        with pytest.raises(ValueError, match=name):
            make_trainer(resume)


class Forgetful(DummyEnv):
    """Keeps no state, as a robot."""

    get_state = set_state = None


def test_a_world_that_keeps_no_state_is_placed_anew(tmp_path, caplog):
    """The rest of the run resumes; the new placement is INITIAL, which is free."""
    train(config(tmp_path, steps=STEPS_PER_UPDATE, eval_freq=0), env=Forgetful(STREAMS))
    resume = resumed(tmp_path, steps=2 * STEPS_PER_UPDATE, eval_freq=0)
    env = Forgetful(STREAMS)
    trainer = make_trainer(resume, env=env)
    assert "keeps no state" in caplog.text
    assert env.calls == [("scene_reset", list(range(STREAMS)))]
    loop = trainer.loop
    assert (loop.preceded_by == Intervention.INITIAL).all()
    before = loop.b
    assert loop.interventions[:, Intervention.INITIAL].tolist() == [2] * STREAMS
    assert trainer.train()
    assert loop.n == 2 * STEPS_PER_UPDATE
    assert before == 0


def test_another_format_is_refused(tmp_path):
    train(config(tmp_path, steps=STEPS_PER_UPDATE, eval_freq=0))
    path = tmp_path / "checkpoints/last/training_state/state.pt"
    torch.save(torch.load(path) | {"format": 99}, path)
    with pytest.raises(ValueError, match="format 99"):
        read_state(tmp_path / "checkpoints/last")


class Harmful:
    """What a stranger's file may hold: Python's pickle would make a folder."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def test_a_strangers_state_is_not_executed_and_no_unsafe_advice_is_passed_on(tmp_path):
    train(config(tmp_path / "run", steps=STEPS_PER_UPDATE, eval_freq=0))
    path = tmp_path / "run/checkpoints/last/training_state/state.pt"
    torch.save({"format": 1, "environment": Harmful(tmp_path / "harm")}, path)
    with pytest.raises(ValueError, match=r"state\.pt") as refused:
        read_state(tmp_path / "run/checkpoints/last")
    assert "weights_only" not in str(refused.value)
    path.write_bytes(pickle.dumps(Harmful(tmp_path / "harm")))
    with pytest.raises(ValueError, match=r"state\.pt"):
        read_state(tmp_path / "run/checkpoints/last")
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize("link", ["metrics.jsonl", "tensorboard", "streams/data"])
def test_a_link_out_of_the_runs_folder_is_refused(link, tmp_path):
    """A stranger's run must not have ours written over."""
    folder, mine = tmp_path / "run", tmp_path / "mine"
    (folder / "streams").mkdir(parents=True)
    (folder / "checkpoints/0001").mkdir(parents=True)
    (folder / "checkpoints/last").symlink_to("0001")
    check_links(folder)
    mine.write_text("mine")
    (folder / link).symlink_to(mine)
    with pytest.raises(ValueError, match=link):
        check_links(folder)


@pytest.mark.parametrize("name", ["training_state/state.pt", "pretrained_model/model.safetensors"])
def test_a_damaged_checkpoint_is_named(name, tmp_path):
    train(config(tmp_path, steps=STEPS_PER_UPDATE, eval_freq=0))
    file = tmp_path / "checkpoints/last" / name
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="000032"):
        make_trainer(resumed(tmp_path))


def budget(reset_budget):
    """T = 12 and U = 8: the first scene reset, which spends the budget, lies between two updates."""
    protocol = ProtocolConfig(
        task_switch_interval=4, update_interval=8, scene_reset_interval=12, task_order="random",
        reset_budget=reset_budget,
    )  # fmt: skip
    return {"protocol": protocol, "eval_freq": 48, "save_freq": 0}


def test_a_run_that_a_budget_stopped_resumes_as_if_it_had_not(tmp_path):
    """Its last evaluation is not there any more, and keeps no due one away."""

    def evaluated(folder):
        return [line["interaction_steps"] for line in metrics(folder, "evaluation")]

    train(config(tmp_path / "whole", **budget(None)))
    stopped = train(config(tmp_path / "stopped", **budget(4)))
    assert (stopped.loop.t, stopped.loop.updates) == (12, 1)
    end = metrics(tmp_path / "stopped", "end")[-1]
    assert (end["interaction_steps"], end["interventions"]) == (48, 5)
    for _ in range(2):
        assert evaluated(tmp_path / "stopped") == [0, 48]
        # With nothing left to do it is made again.
        train(resumed(tmp_path / "stopped", **budget(4)))
    torch.manual_seed(999)
    train(resumed(tmp_path / "stopped", **budget(None)))
    assert_same_run(tmp_path / "whole", tmp_path / "stopped")
    assert evaluated(tmp_path / "stopped") == [0, 64, 96, 128]
