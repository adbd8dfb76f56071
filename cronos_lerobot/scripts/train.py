"""`cronos-train`: reset-free reinforcement learning of a LeRobot policy.

Example:
    cronos-train --policy.path=<checkpoint> --env.type=cronos --env.scene=kitchen_2x2 \\
        --protocol.scene_reset_interval=1280 --steps=1300000 --output_dir=outputs/train/eer --resume=auto
"""

import logging
import signal
import sys
from contextlib import ExitStack, nullcontext
from pathlib import Path

import torch
from httpx import HTTPError
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from cronos_lerobot.hub.config import PolicyConfig
from cronos_lerobot.hub.push import PublishError, explained
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.ranks import choose_gpu, join_ranks
from cronos_lerobot.scripts.errors import WORK_ERRORS, error_line, reason, stop
from cronos_lerobot.scripts.publish import publish_policy
from cronos_lerobot.training.checkpoint import read_state
from cronos_lerobot.training.config import AUTO, CronosTrainConfig, check, complete
from cronos_lerobot.training.factory import make_parts
from cronos_lerobot.training.reading import check_resumed, read_config
from cronos_lerobot.training.run import Run
from cronos_lerobot.training.run_folder import check_links, clear_unfinished, is_finished, last_checkpoint
from cronos_lerobot.training.stopping import StopRequest, end_by
from cronos_lerobot.training.trainer import Trainer


def train(config: CronosTrainConfig) -> None:
    """Train as `config` says: from the start, from a checkpoint, or not at all if `--resume=auto` has done it."""
    with ExitStack() as stack:
        # What a policy or --peft.* needs may not be installed.
        with error_line(ImportError):
            trainer = _prepare(config, stack)
        if trainer is None:
            return
        # What keeps nothing ends at once.
        request = StopRequest()
        with request if config.save_checkpoint else nullcontext(), error_line(only=WORK_ERRORS):
            try:
                has_ended = trainer.train(request)
            except KeyboardInterrupt:
                # A robot stops at once, and the run resumes from its last checkpoint.
                request.number = request.number or signal.SIGINT
                has_ended = False
    ranks = trainer.run.ranks
    if not has_ended:
        ranks.leave()
        # None: another of the processes was told.
        end_by(request.number or signal.SIGTERM)
    try:
        if ranks.is_main:
            push_to_hub(config)
    finally:
        ranks.leave()


def _prepare(config: CronosTrainConfig, stack: ExitStack) -> Trainer | None:
    """Make all that a run needs, to the point where it can train; None if the run is done.

    Args:
        config: of the run.
        stack: what is to be closed when the run is over.
    """
    complete(config)
    if config.resume and config.checkpoint_path is None:
        config.checkpoint_path = last_checkpoint(Path(config.output_dir or ""))
    check(config)
    assert config.policy is not None
    assert config.output_dir is not None
    # Nobody gets past this before all have looked at the output folder.
    ranks = join_ranks(config.policy.device)
    if ranks.is_main:
        stack.enter_context(FolderLock(config.output_dir))
    config.output_dir = ranks.broadcast(config.output_dir)
    init_logging(console_level="INFO" if ranks.is_main else "ERROR")
    if config.resume == AUTO and is_finished(config):
        logging.info(f"The run in {config.output_dir} is done; more --steps resume it.")
        return None
    state = None
    if config.checkpoint_path is not None:
        check_links(config.output_dir)
        state = read_state(config.checkpoint_path)
        check_resumed(config, state)
    elif ranks.is_main:
        _claim(config)
    # Sums depend on it in their last digits: the run's config says it, and a resumed run keeps to it.
    config.torch_threads = config.torch_threads or torch.get_num_threads()
    torch.set_num_threads(config.torch_threads)
    choose_gpu(config.policy.device)
    if config.policy.push_to_hub and config.policy.repo_id:
        logging.info(f"At its end the run is pushed to {config.policy.repo_id}.")
    parts = make_parts(config, ranks)
    stack.callback(parts.env.close)
    return Trainer(Run(config, parts), state)


def _claim(config: CronosTrainConfig) -> None:
    """Make sure that a new run has its output folder for itself."""
    folder = Path(config.output_dir or "")
    if config.resume == AUTO:
        clear_unfinished(folder)
    elif folder.exists():
        raise FileExistsError(f"{folder} exists; choose another --output_dir, or --resume=auto.")


def push_to_hub(config: CronosTrainConfig) -> None:
    """Publish what was trained at `--policy.repo_id`, if that was given and pushing is on.

    If the Hub refuses it, the program ends with one line: what was trained is there, and this pushes it.
    """
    policy, path = config.policy, config.output_dir
    assert policy is not None
    assert path is not None
    if not (policy.push_to_hub and policy.repo_id):
        return
    try:
        with explained(policy.repo_id):
            publish_policy(PolicyConfig(policy.repo_id, path=path, private=policy.private))
    except (PublishError, ValueError, OSError, HTTPError) as error:
        private = " --private=true" if policy.private else ""
        command = f"cronos-publish policy --path={path} --repo_id={policy.repo_id}{private}"
        stop(f"the run in {path} is whole but could not be pushed; `{command}` pushes it: {reason(error)}")


def main() -> None:
    """Parse the command line and train."""
    register_third_party_plugins()
    with error_line():
        config = read_config(sys.argv[1:])
    train(config)


if __name__ == "__main__":
    main()
