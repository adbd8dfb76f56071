"""Meta-World's drawer with help: Meta-World's own script does the next task of a stream that has failed twice.

    PYTHONPATH=examples cronos-train --env.discover_packages_path=metaworld_helped --env.type=metaworld_helped \
        --algorithm.type=imitation --policy.type=pocketvla --policy.action_bounds=unit \
        --protocol.end_effector_reset=false --output_dir=outputs/train/drawer
"""

from dataclasses import dataclass

import numpy as np
from lerobot.envs.configs import EnvConfig
from metaworld.policies import SawyerDrawerCloseV3Policy, SawyerDrawerOpenV3Policy
from metaworld_drawer import DrawerConfig
from scripted_help import ScriptedHelp

# Meta-World's script for closing aims below the handle of its own scene.
SCRIPTS = {True: (SawyerDrawerOpenV3Policy(), 0.0), False: (SawyerDrawerCloseV3Policy(), 0.05)}


class DrawerExpert:
    """Meta-World's scripts for the current tasks of a `DrawerStreams`."""

    def __init__(self, env):
        self.env = env

    def reset(self, ids):
        """Nothing is remembered."""

    def act(self):
        """Actions (N, 4)."""
        return np.stack(
            [self._act(bool(opens), seen) for opens, seen in zip(self.env.opens, self.env.seen, strict=True)]
        )

    def _act(self, opens, seen):
        script, above = SCRIPTS[opens]
        # Hand, gripper, and the handle, at the places that the script reads.
        observation = np.zeros(39)
        observation[:7] = [*seen[:4], *seen[7:9], seen[9] + above]
        return np.clip(script.get_action(observation), -1, 1)


@EnvConfig.register_subclass("metaworld_helped")
@dataclass
class HelpedDrawerConfig(DrawerConfig):
    """`--env.type=metaworld_helped`: the drawer, with help while training."""

    def create_streams(self, num_envs):
        """The world that `cronos-train` trains in."""
        env = super().create_streams(num_envs)
        return ScriptedHelp(env, DrawerExpert(env))

    def create_eval_streams(self, num_envs):
        """Nobody helps in evaluations."""
        return super().create_streams(num_envs)
