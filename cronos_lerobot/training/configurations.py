"""How many configurations of a benchmark a run asks for."""

from __future__ import annotations

from lerobot_env_cronos import Benchmark

from cronos_lerobot.training.config import CronosTrainConfig


def check_configurations(config: CronosTrainConfig, benchmark: Benchmark, name: str) -> None:
    """Raise a ValueError, if a run's scene resets or evaluations are of more configurations than there are.

    Args:
        config: of the run.
        benchmark: whose configurations they are.
        name: of the benchmark or scene, for the error.
    """
    wanted = {"protocol.num_configurations": ("train", config.protocol.num_configurations)}
    if config.eval_freq or config.eval_at_interventions:
        wanted["eval.n_episodes"] = (config.eval.split, config.eval.n_episodes)
    for flag, (split, count) in wanted.items():
        available = len(benchmark.configurations[split])
        if count > available:
            raise ValueError(
                f"--{flag}={count}, but {name} has {available} {split} configurations:"
                f" give --{flag}={available} or fewer."
            )
