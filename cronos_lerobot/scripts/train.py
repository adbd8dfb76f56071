"""`cronos-train`: reset-free reinforcement learning of a LeRobot policy.

Example:
    cronos-train --policy.path=<checkpoint> --env.type=cronos --env.scene=kitchen_2x2 \
        --protocol.scene_reset_interval=1280 --steps=1300000 --output_dir=outputs/train/eer
"""

import signal
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from httpx import HTTPError
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import init_logging
from lerobot_env_cronos import SequentialVectorEnv

from cronos_lerobot.agents.base import LearningAgent
from cronos_lerobot.agents.registry import check_agent
from cronos_lerobot.hub.config import PolicyConfig
from cronos_lerobot.hub.push import PublishError, Target, explained
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.processes import choose_gpu, join_processes
from cronos_lerobot.scripts.errors import error_line, parse_command_line, reason, stop
from cronos_lerobot.scripts.publish import publish_policy
from cronos_lerobot.training.checkpoint import save_model
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.factory import make_env, make_eval_env, make_policy_and_processors
from cronos_lerobot.training.stopping import StopRequest, end_by
from cronos_lerobot.training.trainer import Trainer


def train(config: CronosTrainConfig) -> None:
    """Train as `config` says, from the start or from a checkpoint."""
    with ExitStack() as stack:
        # What a policy or --peft.* needs may not be installed.
        with error_line(ImportError):
            config.validate()
            assert config.policy is not None
            # Nobody gets past this before all have seen that the output folder does not exist yet.
            processes = join_processes(config.policy.device)
            mine = processes.share_of(config.num_envs)
            config.record.check_filmed(mine.stop - mine.start)
            assert config.output_dir is not None
            if processes.is_main:
                stack.enter_context(FolderLock(config.output_dir))
            config.output_dir = processes.broadcast(config.output_dir)
            init_logging(console_level="INFO" if processes.is_main else "ERROR")
            # Sums depend on it in their last digits: the run's config says it, and a resumed run keeps to it.
            if config.torch_threads is None:
                config.torch_threads = torch.get_num_threads()
            torch.set_num_threads(config.torch_threads)
            choose_gpu(config.policy.device)
            set_seed(config.seed)
            policy, preprocessor, postprocessor = make_policy_and_processors(config)
            if not processes.is_main:
                set_seed(processes.own_seed(config.seed))
            env = make_env(config, mine.stop - mine.start, processes.local_count)
            stack.callback(env.close)

            def make_own_eval_env(num_envs: int) -> SequentialVectorEnv:
                return make_eval_env(config, num_envs, processes.local_count)

            trainer = Trainer(config, env, make_own_eval_env, policy, preprocessor, postprocessor, processes)
            trainer.load()
            trainer.open()
        # What keeps nothing ends at once.
        request = StopRequest()
        with request if config.save_checkpoint else nullcontext():
            has_ended = trainer.train(request)
    if not has_ended:
        processes.leave()
        # None: another of the processes was told.
        end_by(request.number or signal.SIGTERM)
    try:
        if processes.is_main:
            with told_how_to_push(config):
                push_to_hub(config, trainer.agent, preprocessor, postprocessor)
    finally:
        processes.leave()


@contextmanager
def told_how_to_push(config: CronosTrainConfig) -> Generator[None]:
    """End the program with one line if the Hub refuses a run: what was trained is there, and this pushes it."""
    assert config.policy is not None
    repository = str(config.policy.repo_id)
    try:
        with explained(Target(repository, "model")):
            yield
    except (PublishError, ValueError, OSError, HTTPError) as error:
        command = f"cronos-publish policy --path={config.output_dir} --repo_id={repository}"
        if config.policy.private:
            command += " --private=true"
        what = f"the run in {config.output_dir} is whole but could not be pushed; `{command}` pushes it"
        if not config.save_checkpoint:
            what = "what was trained could not be pushed, and --save_checkpoint=false kept none of it"
        stop(f"{what}: {reason(error)}")


def push_to_hub(config: CronosTrainConfig, agent: LearningAgent, preprocessor: Any, postprocessor: Any) -> None:
    """Publish what the agent trained at `--policy.repo_id`, if that was given and pushing is on."""
    assert config.policy is not None
    if not (config.policy.push_to_hub and config.policy.repo_id):
        return
    with TemporaryDirectory() as folder:
        path = config.output_dir
        if not config.save_checkpoint:
            path = Path(folder)
            save_model(agent, config, preprocessor, postprocessor, path)
        publish_policy(PolicyConfig(config.policy.repo_id, path=path, private=config.policy.private))


def main() -> None:
    """Parse the command line and train."""
    register_third_party_plugins()
    with error_line():
        config = parse_command_line(CronosTrainConfig, {"algorithm": "ppo"}, {"algorithm": check_agent})
    train(config)


if __name__ == "__main__":
    main()
