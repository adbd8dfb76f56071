"""`--env.task_observation=one_hot`: the task for policies that read no instructions."""

import numpy as np
from env_rollouts import make
from lerobot_env_cronos import SequentialVectorEnv, Task, get_scene
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX

SCENE = get_scene("kitchen_2x2")
TOLD = {"obs_type": "environment_state_agent_pos", "task_observation": "one_hot"}
NAMES = (
    "task.object.ketchup_bottle", "task.object.kitchen_shovel",
    "task.receptacle.yellow_plate", "task.receptacle.cloth", "task.receptacle.table",
)  # fmt: skip


def test_two_tasks_in_one_state_differ_there_and_nowhere_else():
    env, untold = make(3, **TOLD), make(3)
    for each in (env, untold):
        each.scene_reset(np.arange(3), np.zeros(3, dtype=int))
    env.set_task(range(3), [SCENE.tasks[0], SCENE.tasks[3], Task("kitchen shovel", None)])
    observation = env.observe()
    state = observation["agent_pos"]
    assert tuple(env.state_names) == WIDOWX.state_names + NAMES
    np.testing.assert_array_equal(untold.observe()["agent_pos"], state[:, :13])
    np.testing.assert_array_equal(untold.observe()["environment_state"], observation["environment_state"])
    # Bottle on the plate; shovel on the cloth; shovel on the table.
    assert state[:, 13:].tolist() == [[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [0, 1, 0, 0, 1]]
    assert env.observation_space.contains(observation)


def test_a_step_is_under_the_old_task_and_what_is_observed_after_the_switch_under_the_new_one():
    env = make(2, **TOLD)
    env.set_task([0, 1], [SCENE.tasks[0], SCENE.tasks[1]])
    stepped, *_ = env.step(np.zeros((2, 7)))
    env.set_task([1], [SCENE.tasks[2]])
    assert stepped["agent_pos"][:, 13:].tolist() == [[1, 0, 1, 0, 0], [1, 0, 0, 1, 0]]
    assert env.observe()["agent_pos"][:, 13:].tolist() == [[1, 0, 1, 0, 0], [0, 1, 1, 0, 0]]


def test_what_would_be_seen_under_each_task_is_what_is_seen_under_it():
    env = make(2, **TOLD)
    before = list(env.current_tasks)
    would = env.observe_under(SCENE.tasks)
    assert env.current_tasks == before
    for task, observation in zip(SCENE.tasks, would, strict=True):
        env.set_task([0, 1], [task, task])
        for name, column in env.observe().items():
            np.testing.assert_array_equal(observation[name], column, err_msg=task.instruction)


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
