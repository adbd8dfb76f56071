"""LeRobot's own processors."""

from lerobot.processor import make_default_pre_post_processors


def make_mine_pre_post_processors(config, dataset_stats=None):
    """What LeRobot calls, by this name, to make them."""
    return make_default_pre_post_processors(config, dataset_stats)
