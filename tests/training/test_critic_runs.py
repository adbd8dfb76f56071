"""Whole runs in which values choose tasks and resets: resuming, many processes, metrics, agents without values."""

import json

import numpy as np
import pytest
import torch
from dummies import DummyEnv, DummyPolicy
from forked_processes import ScriptedPolicy, together
from test_cronos_train import OBSERVATIONS, SMALL, cronos_train
from test_distributed import settings
from test_distributed import train as train_in
from test_trainer import STREAMS, KilledError, MortalEnv, assert_same_run, make_trainer, metrics, train
from test_trainer import config as evaluated_config

from cronos_lerobot.agents.base import ValuingAgent
from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.steering.agent import SteeringAgent
from cronos_lerobot.processes import Processes
from cronos_lerobot.protocol.config import CriticConfig, ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import LoopState, SegmentEnd, Step
from cronos_lerobot.protocol.resets import CriticSceneReset
from cronos_lerobot.training.critic_log import CriticLog
from cronos_lerobot.training.seeding import NamedGenerators

EVERYTHING = {"scene_reset": "critic", "reset_budget": 12, "scene_reset_interval": None}
STAGGERED = {"reset_phase": "staggered", "scene_reset_interval": 16}
LEARNABLE = {"reset_starts": "learnable", "scene_reset_interval": 8}


def config(folder, **options):
    """Runs without evaluations."""
    return evaluated_config(folder, **{"eval_freq": 0} | options)


def critic_protocol(**options):
    """Segments of 4 steps, updates every 8; DummyPolicy's values are some tenths."""
    asks = {"failures": 1} if options.get("scene_reset") == "critic" else {}
    critic = CriticConfig(certain_value=0.5, floor=0.05, **asks)
    defaults = {"task_switch_interval": 4, "update_interval": 8, "task_order": "critic", "critic": critic}
    return ProtocolConfig(**(defaults | options))


@pytest.mark.parametrize("options", [EVERYTHING, STAGGERED, LEARNABLE], ids=["critic", "staggered", "learnable"])
def test_resumed_run_equals_the_unbroken_one(tmp_path, options):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    whole = train(config(unbroken, protocol=critic_protocol(**options)))
    with pytest.raises(KilledError):
        train(
            config(broken, protocol=critic_protocol(**options)),
            env=MortalEnv(STREAMS, diverge_at={(5, 1), (21, 2)}),
        )
    resumed = config(broken, protocol=critic_protocol(**options))
    resumed.checkpoint_path = (broken / "checkpoints/last").resolve()
    torch.manual_seed(999)
    train(resumed, policy_seed=8)
    assert_same_run(unbroken, broken)
    # Something was at stake: other draws are another run.
    rng = NamedGenerators(5).for_numpy("task_order")
    assert whole.generators.for_numpy("task_order").bit_generator.state != rng.bit_generator.state
    assert whole.loop.interventions[:, Intervention.SCENE_RESET].sum() > 0


def test_metrics_say_what_values_chose(tmp_path):
    trainer = make_trainer(config(tmp_path / "run", protocol=critic_protocol(**EVERYTHING)))
    given, acted, ends = [], [], []
    observe = trainer._observe

    def watch(event):
        if isinstance(event, Step) and event.t % 4 == 0:
            given.append(trainer.loop.task_value.copy())
            acted.append(event.action.value)
        if isinstance(event, SegmentEnd):
            ends.append((trainer.loop.n, event, trainer.loop.interventions[:, Intervention.SCENE_RESET].copy()))
        observe(event)

    trainer._observe = watch
    trainer.train()
    # What the order was told is what the policy says when it acts on the first observation.
    np.testing.assert_allclose(given, acted, rtol=1e-5, atol=1e-6)
    updates = [line for line in metrics(tmp_path / "run") if line["kind"] == "update"]
    assert len(updates) == 4
    for number, line in enumerate(updates):
        mine = np.array(given[2 * number : 2 * number + 2])
        assert line["critic"]["task_value"] == pytest.approx(mine.mean())
        success = np.array([event.success for _, event, _ in ends[2 * number : 2 * number + 2]])
        assert line["critic"]["task_value_of_success"] == (
            pytest.approx(mine[success].mean()) if success.any() else None
        )
    logged = [reset for line in updates for reset in line["critic"]["resets"]]
    expected, before = [], np.zeros(STREAMS)
    for n, event, counts in ends:
        expected += [(n, i, int(event.segments_since_reset[i]) + 1) for i in np.flatnonzero(counts > before)]
        before = counts
    assert [(r["interaction_steps"], r["stream"], r["segments"]) for r in logged] == expected
    last = metrics(tmp_path / "run")[-1]
    assert last["kind"] == "resets"
    assert last["scene_resets"] == len(expected) == before.sum() > 0
    assert last["by_stream"] == {str(i): int(count) for i, count in enumerate(before) if count}
    for name in ("by_segments", "by_value"):
        assert sum(last[name].values()) == len(expected)
    value = logged[0]["value"]
    assert any(float(low) <= value < float(low) + 0.1 for low in last["by_value"])
    # Two divergences are paid from the same budget, and the run goes to its end.
    assert last["interventions"] == len(expected) + 2 < 12
    assert last["interaction_steps"] == 128


def test_runs_without_values_log_nothing_of_them(tmp_path):
    train(evaluated_config(tmp_path / "run"))
    lines = metrics(tmp_path / "run")
    assert all("critic" not in line for line in lines)
    assert {line["kind"] for line in lines} == {"update", "evaluation"}


def told_apart(answer):
    """The counters, and beside them what is equal but for rounding."""
    loop, policy = answer
    floats = [*loop.pop("task_value"), *loop.pop("reset_value"), *policy]
    return loop, floats


def in_processes(folder, minibatch_size, **options):
    cfg = settings(folder, minibatch_size, eval_freq=0, **options)
    asked = EVERYTHING | {"reset_budget": 60, "reset_starts": "learnable"}
    cfg.protocol = critic_protocol(**asked, heuristic_reset=True)
    return cfg


def test_resets_of_other_strategies_are_not_logged_as_asked_for():
    log, loop = CriticLog(critic_protocol(**EVERYTHING)), LoopState(2, 1)
    strategy = CriticSceneReset(np.random.default_rng(0), critic_protocol(**EVERYTHING))
    for ids in ([0], [1]):
        end = loop.end_segment()
        loop.count_intervention(np.array([0, 1]), Intervention.SCENE_RESET)
        strategy.count(loop, np.array(ids))
        log.on_segment(end, loop)
    assert [reset["stream"] for reset in log.pop()["critic"]["resets"]] == [0, 1]
    assert loop.interventions[:, Intervention.SCENE_RESET].tolist() == [3, 3]


def test_two_processes_are_one_run(tmp_path):
    loop, policy = told_apart(train_in(Processes(), in_processes(tmp_path / "one", 32)))
    answers = [told_apart(answer) for answer in together(train_in, in_processes(tmp_path / "two", 16))]
    assert answers[0] == answers[1]
    assert answers[0][0] == loop
    assert answers[0][1] == pytest.approx(policy, rel=1e-3, abs=1e-5)
    assert np.array(loop["interventions"])[:, Intervention.SCENE_RESET].sum() > 0


def test_resumed_run_of_two_processes_equals_the_unbroken_one(tmp_path):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    answers = together(train_in, in_processes(unbroken, 4), DummyPolicy)
    assert together(train_in, in_processes(broken, 4), DummyPolicy, 21) == [None, None]
    checkpoint = (broken / "checkpoints/last").resolve()
    assert together(train_in, in_processes(broken, 4, resume=checkpoint), DummyPolicy) == answers
    assert_same_run(unbroken, broken)


def test_values_may_be_switched_on_when_a_run_is_resumed(tmp_path):
    """Periodic resets until then are none of the critic's."""
    first = {"task_order": "random", "scene_reset_interval": 16, "critic": CriticConfig()}
    train(config(tmp_path / "run", steps=64, protocol=critic_protocol(**first)), env=DummyEnv(STREAMS))
    resumed = config(tmp_path / "run", protocol=critic_protocol(**EVERYTHING))
    resumed.checkpoint_path = (tmp_path / "run/checkpoints/last").resolve()
    train(resumed, env=DummyEnv(STREAMS))
    last = json.loads((tmp_path / "run/metrics.jsonl").read_text().splitlines()[-1])
    assert last["interventions_by_kind"]["scene_reset"] == last["scene_resets"] + STREAMS


def test_asking_for_values_changes_nothing_else(tmp_path):
    """Between two steps of a run its agent is asked: the run is the same."""
    train(config(tmp_path / "quiet"))
    trainer = make_trainer(config(tmp_path / "asked"))
    observe = trainer._observe

    def ask(event):
        observe(event)
        seen = trainer.env._observation()
        values = trainer.agent.predict_values(seen, [task.instruction for task in trainer.env.tasks])
        assert values.dtype == np.float32
        assert values.shape == (STREAMS,)

    trainer._observe = ask
    trainer.train()
    assert_same_run(tmp_path / "quiet", tmp_path / "asked")


REAL = (*SMALL, *OBSERVATIONS["state"], "--protocol.task_order=critic")


def test_the_real_scene_stopped_and_resumed(tmp_path, monkeypatch):
    """Asking for observations and for what is complete changes nothing in the simulation."""
    flags = (*REAL, "--protocol.reset_phase=staggered", "--protocol.heuristic_reset=true")
    cronos_train(monkeypatch, *flags, f"--output_dir={tmp_path / 'whole'}")
    cronos_train(monkeypatch, *flags, f"--output_dir={tmp_path / 'broken'}", "--steps=16")
    last = tmp_path / "broken/checkpoints/last/pretrained_model/train_config.json"
    cronos_train(monkeypatch, "--resume=true", f"--config_path={last}", "--steps=32")
    assert_same_run(tmp_path / "whole", tmp_path / "broken")
    # T = 8 is two segments: one of the two streams is reset at every switch.
    lines = metrics(tmp_path / "whole")
    assert lines[-1]["interventions_by_kind"]["scene_reset"] == 4
    assert all(np.isfinite(line["critic"]["task_value"]) for line in lines)


def test_the_real_scene_reset_by_the_critic(tmp_path, monkeypatch):
    cronos_train(
        monkeypatch, *REAL, "--protocol.scene_reset=critic", "--protocol.reset_budget=8",
        "--protocol.scene_reset_interval=null", "--protocol.critic.failures=1",
        "--env.task_observation=one_hot", "--protocol.critic.knows_complete=false",
        f"--output_dir={tmp_path / 'run'}",
    )  # fmt: skip
    last = metrics(tmp_path / "run")[-1]
    # Two streams, four segments, of which all fail: after the first one two of eight may be spent, and so on.
    assert (last["kind"], last["interaction_steps"]) == ("resets", 32)
    assert (last["by_stream"], last["by_segments"]) == ({"0": 3, "1": 3}, {"1": 6})


def test_which_agents_have_values(tmp_path, monkeypatch):
    assert issubclass(PPOAgent, ValuingAgent)
    assert issubclass(SteeringAgent, ValuingAgent)
    message = "^error: protocol.task_order=critic goes by the agent's values, and ImitationAgent has none"
    with pytest.raises(SystemExit, match=message):
        cronos_train(
            monkeypatch, "--algorithm.type=imitation", "--policy.type=pocketvla", "--policy.device=cpu",
            "--env.type=cronos", "--env.obs_type=environment_state_agent_pos", "--num_envs=2",
            "--protocol.task_order=critic", f"--output_dir={tmp_path / 'run'}",
        )  # fmt: skip
    assert not (tmp_path / "run").exists()


def test_values_of_two_processes_are_of_all_streams():
    def ask(processes, cfg):
        from dummies import TASKS, identity_processors

        from cronos_lerobot.training.trainer import Trainer

        mine = processes.share_of(cfg.num_envs)
        env = DummyEnv(mine.stop - mine.start)
        env.x[:] = np.array([0.1, 0.2, 0.3, 0.4])[mine]
        trainer = Trainer(cfg, env, DummyEnv, ScriptedPolicy(), *identity_processors(), processes)
        tau = [task.instruction for task in TASKS]
        return trainer.agent.predict_values(trainer.env.observe(), tau).tolist()

    cfg = config(None)
    assert together(ask, cfg) == [pytest.approx(ask(Processes(), cfg), rel=1e-5)] * 2
