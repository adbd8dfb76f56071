"""`cronos-train`: reset-free reinforcement learning of a LeRobot policy.

Example:
    cronos-train --policy.path=<checkpoint> --env.type=cronos --env.scene=kitchen_2x2 \
        --protocol.scene_reset_interval=1280 --steps=1300000 --output_dir=outputs/train/eer
"""

import sys
from typing import Any

import torch
from draccus.utils import ParsingError
from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import init_logging
from lerobot_env_cronos import SequentialVectorEnv

from cronos_lerobot.processes import join_processes
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.factory import make_env, make_eval_env, make_policy_and_processors
from cronos_lerobot.training.trainer import Trainer


@parser.wrap()
def train(config: CronosTrainConfig) -> None:
    """Train as `config` says, from the start or from a checkpoint."""
    try:
        config.validate()
        assert config.policy is not None
        # Nobody gets past this before all have seen that the output folder does not exist yet.
        processes = join_processes(config.policy.device)
        mine = processes.share_of(config.num_envs)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    config.output_dir = processes.broadcast(config.output_dir)
    init_logging(console_level="INFO" if processes.is_main else "ERROR")
    # Sums depend on it in their last digits: the run's config says it, and a resumed run keeps to it.
    if config.torch_threads is None:
        config.torch_threads = torch.get_num_threads()
    torch.set_num_threads(config.torch_threads)
    set_seed(config.seed)
    policy, preprocessor, postprocessor = make_policy_and_processors(config)
    if not processes.is_main:
        set_seed(config.seed + processes.rank)

    def make_own_eval_env(num_envs: int) -> SequentialVectorEnv:
        return make_eval_env(config, num_envs, processes.local_count)

    try:
        env = make_env(config, mine.stop - mine.start, processes.local_count)
    except ValueError as error:
        sys.exit(f"error: {error}")
    trainer = Trainer(config, env, make_own_eval_env, policy, preprocessor, postprocessor, processes)
    try:
        trainer.train()
    finally:
        env.close()
    if processes.is_main:
        push_to_hub(config, policy, preprocessor, postprocessor)
    processes.leave()


def push_to_hub(config: CronosTrainConfig, policy: Any, preprocessor: Any, postprocessor: Any) -> None:
    """Push the trained policy to `--policy.repo_id`, if it is given and pushing is on."""
    assert config.policy is not None
    if config.policy.push_to_hub and config.policy.repo_id:
        for part in (policy, preprocessor, postprocessor):
            part.push_to_hub(config.policy.repo_id, private=config.policy.private)


def main() -> None:
    """Parse the command line and train."""
    register_third_party_plugins()
    # draccus wants the type of a choice whenever one of its fields is set; PPO is ours.
    given = [argument.split("=")[0] for argument in sys.argv[1:]]
    if "--algorithm.type" not in given and "--config_path" not in given:
        sys.argv.append("--algorithm.type=ppo")
    try:
        train()  # ty: ignore[missing-argument]  (parser.wrap reads it from the command line)
    except ParsingError as error:
        sys.exit(f"error: {error.__cause__ or error}")


if __name__ == "__main__":
    main()
