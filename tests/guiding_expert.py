"""An expert of the dummy world, who leads a stream to its goal."""

import numpy as np

from cronos_lerobot.protocol.experts import Expert, register_expert


@register_expert("guide")
class Guide(Expert):
    """Goes towards the goal by up to 0.2 a step; sees the instructions and the observation alone."""

    def __init__(self, env):
        self.played = []

    def begin(self, ids):
        self.ids = ids
        self.played.append(ids.tolist())

    def act(self, o_t, tau):
        goals = np.array([float(tau[i].removeprefix("go to ")) for i in self.ids])
        actions = np.zeros((len(self.ids), 7))
        actions[:, 0] = np.clip(5 * (goals - o_t["agent_pos"][self.ids, 0]), -1, 1)
        return actions


@register_expert("single guide")
class SingleGuide(Guide):
    """One stream at a time, as a person."""

    capacity = 1
