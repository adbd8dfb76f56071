"""`--env.task_observation=one_hot`: the task for policies that read no instructions."""

import gymnasium as gym
import numpy as np
import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.utils import env_to_policy_features
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv, SequentialVectorEnv, Task, get_scene
from lerobot_env_cronos.simulation.observations import AGENT_POS_NAMES, agent_pos_names

from cronos_lerobot.data.schema import demonstration_features, feature_names, stream_features

STATE = {"obs_type": "environment_state_agent_pos"}
TOLD = STATE | {"task_observation": "one_hot"}
SCENE = get_scene("kitchen_2x2")
NAMES = (
    "task.object.ketchup_bottle", "task.object.kitchen_shovel",
    "task.receptacle.yellow_plate", "task.receptacle.cloth", "task.receptacle.table",
)  # fmt: skip


def test_two_tasks_in_one_state_differ_there_and_nowhere_else():
    env = CronosVectorEnv(3, **TOLD)
    env.scene_reset(np.arange(3), np.zeros(3, dtype=int))
    env.set_task(range(3), [SCENE.tasks[0], SCENE.tasks[3], Task("kitchen shovel", None)])
    observation = env.observe()
    state = observation["agent_pos"]
    assert env.agent_pos_names == AGENT_POS_NAMES + NAMES
    assert state.shape == (3, 18)
    np.testing.assert_array_equal(state[:, :13], np.tile(state[0, :13], (3, 1)))
    np.testing.assert_array_equal(observation["environment_state"][1:], observation["environment_state"][:-1])
    # Bottle on the plate; shovel on the cloth; shovel on the table.
    assert state[:, 13:].tolist() == [[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [0, 1, 0, 0, 1]]
    untold = CronosVectorEnv(3, **STATE)
    untold.scene_reset(np.arange(3), np.zeros(3, dtype=int))
    np.testing.assert_array_equal(untold.observe()["agent_pos"], state[:, :13])
    assert env.observation_space.contains(observation)


def test_a_step_is_under_the_old_task_and_what_is_observed_after_the_switch_under_the_new_one():
    env = CronosVectorEnv(2, **TOLD)
    env.set_task([0, 1], [SCENE.tasks[0], SCENE.tasks[1]])
    stepped, *_ = env.step(np.zeros((2, 7)))
    env.set_task([1], [SCENE.tasks[2]])
    assert stepped["agent_pos"][:, 13:].tolist() == [[1, 0, 1, 0, 0], [1, 0, 0, 1, 0]]
    assert env.observe()["agent_pos"][:, 13:].tolist() == [[1, 0, 1, 0, 0], [0, 1, 1, 0, 0]]
    assert env.observe(np.array([1]))["agent_pos"][:, 13:].tolist() == [[0, 1, 1, 0, 0]]


def test_what_would_be_seen_under_each_task_is_what_is_seen_under_it():
    env = CronosVectorEnv(2, **TOLD)
    before = [task.instruction for task in env.tasks]
    would = env.observe_under(SCENE.tasks)
    assert [task.instruction for task in env.tasks] == before
    for task, observation in zip(SCENE.tasks, would, strict=True):
        env.set_task([0, 1], [task, task])
        for name, column in env.observe().items():
            np.testing.assert_array_equal(observation[name], column, err_msg=task.instruction)
    untold = CronosVectorEnv(2, **STATE).observe_under(SCENE.tasks)
    np.testing.assert_array_equal(untold[3]["agent_pos"], would[0]["agent_pos"][:, :13])


def test_a_chain_is_told_its_next_task_when_it_begins():
    env = SequentialVectorEnv(1, ordering=[SCENE.tasks[3], SCENE.tasks[0]], window=2, advance="on_success", **TOLD)
    observation, _ = env.reset(seed=0)
    assert observation["agent_pos"][0, 13:].tolist() == [0, 1, 0, 1, 0]
    step_streams = env.step_streams

    def complete(actions, ids):
        result = step_streams(actions, ids)
        env.is_success[ids] = True
        return result

    env.step_streams = complete
    observation, *_ = env.step(np.zeros((1, 7)))
    assert env.instructions == [SCENE.tasks[0].instruction]
    assert observation["agent_pos"][0, 13:].tolist() == [1, 0, 1, 0, 0]


def test_features_and_names_follow_the_flag():
    config = CronosEnvConfig(**TOLD)
    assert env_to_policy_features(config)["observation.state"].shape == (18,)
    assert env_to_policy_features(CronosEnvConfig(**STATE))["observation.state"].shape == (13,)
    env = config.create_envs(2)["independent_train"][1]
    assert env.reset(seed=[0, 1])[0]["agent_pos"][:, 13:].tolist() == [[1, 0, 0, 1, 0]] * 2
    for features in (demonstration_features, stream_features):
        names = features(env.single_observation_space, **feature_names(env.env))["observation.state"]["names"]
        assert names[13:] == list(NAMES)
    assert len(agent_pos_names(get_scene("kitchen_3x3"), "one_hot")) == 13 + 3 + 4
    single = gym.make("lerobot_env_cronos/kitchen_2x2-v1", task=SCENE.tasks[2].instruction, **TOLD)
    assert single.reset(seed=0)[0]["agent_pos"][13:].tolist() == [0, 1, 1, 0, 0]
    with pytest.raises(
        ValueError, match=r"unknown env.task_observation 'words'; valid values: \['none', 'one_hot'\]"
    ):
        CronosEnvConfig(task_observation="words")
    with pytest.raises(ValueError, match=r"unknown task_observation 'words'; valid values: \['none', 'one_hot'\]"):
        CronosVectorEnv(1, task_observation="words")


@pytest.mark.parametrize(("size", "given", "needed"), [(18, "none", "one_hot"), (13, "one_hot", "none")])
def test_a_policy_of_the_other_kind_is_told_the_flag(size, given, needed):
    from lerobot.policies.act.configuration_act import ACTConfig

    from cronos_lerobot.evaluation.policy_env import check_observations, check_task_observation

    features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (size,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (48,)),
    }
    policy = ACTConfig(input_features=features, device="cpu", push_to_hub=False)
    for check in (check_observations, check_task_observation):
        with pytest.raises(
            ValueError, match=rf"of {size} numbers, as with --env\.task_observation={needed}: give it"
        ):
            check(policy, CronosEnvConfig(**STATE, task_observation=given))
        check(policy, CronosEnvConfig(**STATE, task_observation=needed))
