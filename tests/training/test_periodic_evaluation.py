"""The evaluation of `cronos-train` and that of `cronos-eval` are one: the same episodes, motion for motion."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
from forked_processes import together
from lerobot.configs import PreTrainedConfig
from lerobot_env_cronos import CronosEnvConfig
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.agents.processing import make_processors
from cronos_lerobot.evaluation.config import CronosEvalConfig, SuitesConfig
from cronos_lerobot.evaluation.independent import run_independent
from cronos_lerobot.evaluation.results import describe_episodes
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.factory import make_eval_env, make_policy_and_processors

N_EPISODES, SEED, TEMPERATURE = 2, 7, 0.8


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("pocketvla")
    return save_policy(folder, "pocketvla", STATE, hidden_width=16, hidden_depth=1)


@pytest.fixture(scope="module")
def of_cronos_eval(checkpoint):
    """Episodes and motions of `cronos-eval`."""
    ended = []

    def keep(folder, results, chains, render, count, fps):
        ended.extend(chains)

    with TemporaryDirectory() as folder:
        config = CronosEvalConfig(CronosEnvConfig(**STATE), policy(checkpoint), seed=SEED, output_dir=Path(folder))
        config.eval = SuitesConfig(
            ["independent"], ["held_out"], N_EPISODES, temperature=TEMPERATURE, batch_size=8
        )
        config.resolve()
        (results,) = Evaluation(config, draw=keep).run()
    assert results["episodes"] == describe_episodes(ended, SEED)
    return by_episode(ended)


def by_episode(ended):
    return {
        (e["number"], e["configuration"]): (e, result.trajectory.states)
        for e, result in zip(describe_episodes(ended, SEED), ended, strict=True)
    }


def policy(checkpoint):
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path, config.device = checkpoint, "cpu"
    return config


def of_cronos_train(ranks, checkpoint, batch_size):
    """The same of the evaluation during a training."""
    config = CronosTrainConfig(CronosEnvConfig(**STATE), policy(checkpoint))
    network, *pipelines = make_policy_and_processors(config)
    env = make_eval_env(config, batch_size, ranks.local_count)
    results = run_independent(
        env, network, make_processors(network, *pipelines), n_episodes=N_EPISODES, split="held_out",
        temperature=TEMPERATURE, seed=SEED, ranks=ranks, states=lambda ids: env.positions(ids).astype(np.float32),
    )  # fmt: skip
    return by_episode(results)


def check_the_same(found, expected):
    assert list(found) == list(expected)
    assert len(found) == 4 * N_EPISODES
    for key, (record, qpos) in expected.items():
        assert found[key][0] == record
        np.testing.assert_array_equal(found[key][1], qpos)
    # They are no motions of nothing.
    assert len({qpos.tobytes() for _, qpos in expected.values()}) == len(expected)


@pytest.mark.parametrize("batch_size", [1, 3, 64])
def test_an_episode_is_the_same_in_both_evaluations_at_any_batch_size(checkpoint, of_cronos_eval, batch_size):
    check_the_same(of_cronos_train(Ranks(), checkpoint, batch_size), of_cronos_eval)


def test_processes_share_the_episodes_out_and_all_know_the_whole_result(checkpoint, of_cronos_eval):
    for found in together(of_cronos_train, checkpoint, 3):
        check_the_same(found, of_cronos_eval)
