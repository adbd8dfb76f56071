"""LeRobot finds the policy if the distribution is called like this module, with underscores."""

from lerobot_policy_mine.configuration_mine import MineConfig as MineConfig
