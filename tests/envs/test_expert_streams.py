"""The scripted expert in some of the streams of an environment."""

import numpy as np
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert


def test_an_expert_of_some_streams_acts_there_as_one_of_all():
    env = CronosVectorEnv(4, obs_type="environment_state_agent_pos")
    env.set_task(np.arange(4), env.scene.tasks)
    streams = np.array([3, 1])
    rng = np.random.default_rng(0)
    for _ in range(12):
        # Wherever arms and bodies are.
        env.step(rng.uniform(-0.03, 0.03, (4, 7)))
    everyone, some = ScriptedExpert(env), ScriptedExpert(env, streams=streams)
    closed = False
    for _ in range(40):
        actions = everyone.act()
        np.testing.assert_allclose(some.act(), actions[streams], atol=1e-9)
        closed |= bool((actions[streams, 6] < 0.5).any())
        env.step(actions)
    # Far enough to grasp and to choose a place.
    assert closed
