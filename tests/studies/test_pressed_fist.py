"""A fist that is pressed onto an object passes for a grasp, and would not if the fingers' sides were looked at."""

import numpy as np
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert

from cronos_lerobot.studies.pressed_fist import is_outwards, press


def test_a_fist_is_no_hold_and_an_experts_grasp_is():
    grasped, outwards, lifted = press("playroom_2x2", "plastic bottle", 8)
    assert grasped.sum() > 20
    assert outwards.tolist() == [0] * 8
    assert not lifted.any()
    env = CronosVectorEnv(4, obs_type="environment_state_agent_pos")
    expert, held, both = ScriptedExpert(env), np.zeros(4, int), np.zeros(4, int)
    for _ in range(30):
        env.step(expert.act())
        is_held = env.simulation.is_grasped("ketchup bottle")
        held += is_held
        both += is_held & is_outwards(env.simulation, "ketchup bottle")
    assert (held > 5).all()
    assert (both >= 0.8 * held).all()
    env.close()
