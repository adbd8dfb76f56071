"""The sequential suite: frozen orderings, the rules of a chain by hand, and LeRobot's interface."""

import json
from importlib import resources

import numpy as np
import pytest
from lerobot.envs.factory import make_env, make_env_config
from lerobot_env_cronos import SCENES, CronosEnvConfig, SequentialVectorEnv, get_scene, load_orderings
from lerobot_env_cronos.benchmark.benchmark import packaged_benchmark
from lerobot_env_cronos.benchmark.orderings import draw_orderings
from lerobot_env_cronos.expert.expert import ScriptedExpert
from scripted_env import ScriptedEnv

STATE = "environment_state_agent_pos"
TASKS = get_scene("kitchen_2x2").tasks
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])


@pytest.mark.parametrize("scene", SCENES)
def test_orderings_are_what_the_seed_draws(scene):
    data = resources.files("lerobot_env_cronos").joinpath(f"data/orderings/{scene}.json").read_bytes()
    assert list(map(tuple, json.loads(data)["orderings"])) == draw_orderings(len(get_scene(scene).tasks))


@pytest.mark.parametrize("scene", SCENES)
def test_of_ten_orderings_only_the_first_is_the_training_cycle_or_a_rotation_of_it(scene):
    orderings, tasks = load_orderings(scene), get_scene(scene).tasks
    rotations = [tasks[start:] + tasks[:start] for start in range(len(tasks))]
    is_cycle = [ordering in rotations for ordering in orderings]
    assert is_cycle == [True] + [False] * 9
    assert [group.is_training_cycle for group in packaged_benchmark(scene).sequential["train"]] == is_cycle


def test_small_scenes_have_fewer_orderings():
    # The other permutation of two tasks is a rotation of the cycle; of three, the three odd ones are none.
    assert draw_orderings(1) == [(0,)]
    assert draw_orderings(2) == [(0, 1)]
    assert draw_orderings(3)[0] == (0, 1, 2)
    assert sorted(draw_orderings(3)[1:]) == [(0, 2, 1), (1, 0, 2), (2, 1, 0)]


def play(env):
    """Step to the end; per chain the rewards' times, the (time, instruction) seen, and the end's flags."""
    env.reset(seed=0)
    rewards, ends = [[] for _ in env.script], [None for _ in env.script]
    seen = [[(0, text)] for text in env.call("task_description")]
    while not env.done.all():
        _, reward, terminated, truncated, info = env.step(np.tile(STILL, (env.num_envs, 1)))
        assert reward.tolist() == info["task_success"].tolist()
        for i in range(env.num_envs):
            if reward[i]:
                rewards[i].append(env.clock)
            if terminated[i] or truncated[i]:
                assert ends[i] is None
                ends[i] = (env.clock, bool(terminated[i]), bool(info["is_success"][i]))
            if env.call("task_description")[i] != seen[i][-1][1]:
                seen[i].append((env.clock, env.call("task_description")[i]))
    return rewards, seen, ends


def test_a_window_lasts_80_steps_whenever_its_task_was_complete():
    rewards, seen, ends = play(ScriptedEnv([[1, 80, 30, 7], [80, 80, 80, 80]]))
    assert rewards == [[1, 160, 190, 247], [80, 160, 240, 320]]
    texts = [task.instruction for task in TASKS]
    assert seen == [list(zip([0, 80, 160, 240], texts, strict=True))] * 2
    # Nothing is left to do after the last task: the chain does not sit out its window.
    assert ends == [(247, True, True), (320, True, True)]


def test_on_success_goes_on_at_once():
    rewards, seen, ends = play(ScriptedEnv([[1, 80, 30, 7], [80, 80, 80, 80]], advance="on_success"))
    assert rewards == [[1, 81, 111, 118], [80, 160, 240, 320]]
    assert [time for time, _ in seen[0]] == [0, 1, 81, 111]
    assert ends == [(118, True, True), (320, True, True)]


@pytest.mark.parametrize("advance", ["window", "on_success"])
@pytest.mark.parametrize("k", range(4))
def test_the_first_failure_ends_the_chain_and_freezes_it(k, advance):
    script = [80] * 4
    script[k] = 81  # a step too late
    env = ScriptedEnv([script, [80] * 4], advance=advance)
    rewards, _, ends = play(env)
    assert rewards[0] == [80 * (j + 1) for j in range(k)]
    assert ends[0] == (80 * (k + 1), False, False)
    assert env.chain_length.tolist() == [k, 4]
    assert env.stepped.count([1]) == 320 - 80 * (k + 1)
    _, reward, terminated, truncated, info = env.step(np.full((2, 7), np.nan))
    flags = [reward, terminated, truncated, info["is_success"], info["task_success"]]
    assert not np.any(flags)


def test_the_arm_goes_home_between_tasks_only_if_asked():
    quick = [[5, 5, 5, 5], [80, 80, 80, 81]]
    env = ScriptedEnv(quick, advance="on_success")
    play(env)
    assert env.homed == []
    env = ScriptedEnv(quick, advance="on_success", end_effector_reset=True)
    play(env)
    assert env.homed == [(5, [0]), (10, [0]), (15, [0]), (80, [1]), (160, [1]), (240, [1])]


def test_a_broken_simulation_fails_the_chain_even_on_success():
    env = ScriptedEnv([[10, 10, 10, 10]] * 2, diverge_at={(10, 0), (85, 1)})
    rewards, _, ends = play(env)
    assert rewards == [[], [10]]
    assert ends == [(10, False, False), (85, False, False)]


def test_frozen_chains_keep_their_last_picture():
    env = SequentialVectorEnv(
        2, ordering=TASKS, observation_height=32, observation_width=32, privileged_state=True
    )
    env.reset(seed=0)
    down = np.tile([0, 0, -0.02, 0, 0, 0, 1.0], (2, 1))
    before = env.step(down)[0]
    env.done[0] = True
    after = env.step(down)[0]
    pairs = [(before[key], after[key]) for key in ("agent_pos", "environment_state")]
    for old, new in [*pairs, (before["pixels"]["front"], after["pixels"]["front"])]:
        np.testing.assert_array_equal(old[0], new[0])
        assert (old[1] != new[1]).any()
    # What is rendered for the running ones alone is what is rendered for all.
    np.testing.assert_array_equal(env.observe()["pixels"]["front"], after["pixels"]["front"])
    env.close()


@pytest.mark.parametrize("advance", ["window", "on_success"])
def test_the_expert_completes_chains_and_a_policy_that_does_nothing_none(advance):
    n = 4
    env = SequentialVectorEnv(n, ordering=load_orderings("kitchen_2x2")[1], advance=advance, obs_type=STATE)
    expert = ScriptedExpert(env)
    env.reset(seed=0)
    steps = 0
    while not env.done.all():
        env.step(expert.act())
        steps += 1
    # The expert fails about one task in a hundred.
    assert (env.chain_length == 4).sum() >= n - 1
    assert (240 < steps <= 320) if advance == "window" else (40 < steps <= 320)
    env.reset(seed=0)
    for step in range(80):
        _, reward, _, truncated, _ = env.step(np.tile(STILL, (n, 1)))
        assert not reward.any()
        assert truncated.all() == (step == 79)


@pytest.mark.parametrize("scene", SCENES)
def test_lerobot_builds_ten_orderings_of_every_scene(scene):
    config = make_env_config("cronos", scene=scene, suite="sequential", obs_type=STATE, advance="on_success")
    envs = make_env(config, n_envs=2)["sequential_train"]
    assert list(envs) == list(range(10))
    env, ordering = envs[7], load_orderings(scene)[7]
    env.reset(seed=[0, 1], options={"lerobot_new_rollout": True})
    assert env.call("task_description") == (ordering[0].instruction,) * 2
    assert env.call("_max_episode_steps") == (get_scene(scene).steps_per_task * len(ordering),) * 2
    assert (env.ordering, env.advance) == (ordering, "on_success")
    assert list(CronosEnvConfig(scene=scene, suite="sequential", task="7").create_envs(1)["sequential_train"]) == [
        7
    ]
    with pytest.raises(ValueError, match="10"):
        CronosEnvConfig(scene=scene, suite="sequential", task="10")


def test_a_step_says_what_was_grasped_of_the_task_that_was_acted_on(monkeypatch):
    """Not of the next one, which a switch has judged meanwhile."""
    env = SequentialVectorEnv(1, ordering=[TASKS[0], TASKS[3]], advance="on_success", obs_type=STATE)
    env.reset(seed=0)
    monkeypatch.setattr(env.simulation, "is_on", lambda obj, receptacle: np.array([True]))
    monkeypatch.setattr(env.simulation, "is_grasped", lambda obj: np.array([obj == TASKS[0].object]))
    assert env.step(STILL[None])[-1]["is_grasped"].all()
    assert env.instructions == [TASKS[3].instruction]
    assert not env.is_grasped.any()
