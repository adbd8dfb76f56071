"""Runs that are killed or stopped in an evaluation, and runs that go on from a checkpoint that is not the last."""

import signal

import pytest
from test_trainer import STEPS_PER_UPDATE, KilledError, assert_same_run, config, make_trainer, metrics, train

from cronos_lerobot.training.stopping import StopRequest


def killed():
    raise KilledError


def told_to_stop():
    signal.raise_signal(signal.SIGTERM)


def run_with(cfg, happens):
    """Train until something happens in the evaluation that is due after two updates."""
    trainer = make_trainer(cfg)
    evaluate = trainer._evaluate

    def interrupted():
        if trainer.loop.n == 2 * STEPS_PER_UPDATE:
            happens()
        evaluate()

    trainer._evaluate = interrupted
    with StopRequest() as stop:
        return trainer.train(stop)


def go_on(cfg):
    cfg.checkpoint_path = (cfg.output_dir / "checkpoints/last").resolve()
    train(cfg, policy_seed=8)


def test_a_kill_in_an_evaluation_loses_the_evaluation_alone(tmp_path):
    """It was due with the checkpoint, as by default."""
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    both = {"save_freq": 2 * STEPS_PER_UPDATE, "eval_at_interventions": [5]}
    train(config(unbroken, **both))
    with pytest.raises(KilledError):
        run_with(config(broken, **both), killed)
    assert (broken / "checkpoints/last").resolve().name == "000064"
    go_on(config(broken, **both))
    assert_same_run(unbroken, broken)


@pytest.mark.parametrize("saved_every", [2, 4])
def test_a_run_that_is_told_to_stop_in_an_evaluation_begins_no_other_update(saved_every, tmp_path):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    both = {"save_freq": saved_every * STEPS_PER_UPDATE}
    train(config(unbroken, **both))
    assert not run_with(config(broken, **both), told_to_stop)
    assert [line["interaction_steps"] for line in metrics(broken) if line["kind"] == "evaluation"] == [0, 64]
    assert metrics(broken)[-1]["interaction_steps"] == 64
    go_on(config(broken, **both))
    assert_same_run(unbroken, broken)


def test_an_evaluation_that_its_checkpoint_knows_of_stays_as_it_was_made(tmp_path):
    train(config(tmp_path, steps=2 * STEPS_PER_UPDATE))
    before = metrics(tmp_path)
    assert before[-1]["kind"] == "evaluation"
    more = config(tmp_path, steps=3 * STEPS_PER_UPDATE, eval_freq=0)
    more.checkpoint_path = tmp_path / "checkpoints/last"
    train(more)
    assert metrics(tmp_path)[: len(before)] == before


def test_who_goes_on_from_an_earlier_checkpoint_goes_on_from_there_again(tmp_path):
    """Killed before its first checkpoint: `last` is not of the end that the metrics have lost."""
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    for folder in (unbroken, broken):
        train(config(folder))
    early = config(broken, save_freq=0, eval_freq=STEPS_PER_UPDATE)
    early.checkpoint_path = broken / "checkpoints/000032"
    with pytest.raises(KilledError):
        run_with(early, killed)
    assert (broken / "checkpoints/last").resolve().name == "000032"
    go_on(config(broken))
    assert_same_run(unbroken, broken)


def test_what_cannot_be_removed_of_an_old_checkpoint_ends_no_run(tmp_path, monkeypatch):
    removed = []
    monkeypatch.setattr(
        "cronos_lerobot.training.checkpoint.shutil.rmtree",
        lambda path, ignore_errors=False: removed.append((path.name, ignore_errors)),
    )
    train(config(tmp_path, keep_checkpoints=1))
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir() if not p.name.startswith(".partial_")) == [
        "000128",
        "last",
    ]
    assert removed
    assert all(name.startswith(".partial_") and ignores for name, ignores in removed)
