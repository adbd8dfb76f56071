"""The independent suite of a policy that is at hand: the periodic evaluation of `cronos-train`.

Its chains, random numbers and actors are those of `cronos-eval`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from lerobot.utils.random_utils import get_rng_state, set_rng_state

from cronos_lerobot.agents.base import samples
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.evaluation.actors import make_actor
from cronos_lerobot.evaluation.chains import ChainResult, ChainRunner, Rules
from cronos_lerobot.evaluation.results import describe_episodes, numbers_of
from cronos_lerobot.evaluation.suites import INDEPENDENT, benchmark_of, make_chains, sampling_seed
from cronos_lerobot.protocol.streams import STEPS_PER_TASK
from cronos_lerobot.ranks import Ranks


def run_independent(
    env: Any,
    policy: Any,
    processors: PolicyProcessors,
    *,
    n_episodes: int | None,
    split: str,
    temperature: float,
    seed: int,
    window: int = STEPS_PER_TASK,
    ranks: Ranks | None = None,
    states: Callable[[np.ndarray], np.ndarray] | None = None,
) -> list[ChainResult]:
    """Run every task of the environment's benchmark with a policy, and leave everything else as it was.

    If the policy takes `uniform` (see `TrainablePolicy`), its episodes do not depend on the number of environments
    and processes. A policy that draws from a generator gives the same result with the same number of both.

    Args:
        env: environments of the evaluation's own, never those of a training.
        policy: a LeRobot policy on its device, or what acts instead of it by `sample_actions`.
        processors: between `env` and `policy`.
        n_episodes: the first N configurations of every task; None takes all.
        split: `train` or `held_out`.
        temperature: of the sampling, 0 for the likeliest action.
        seed: of the sampling.
        window: control steps of a task.
        ranks: processes that share the episodes; all of them call this and get the whole result.
        states: of `ChainRunner`, to return the trajectories, too.

    Returns:
        The episodes, task by task.
    """
    ranks = ranks or Ranks()
    chains = make_chains(benchmark_of(env), INDEPENDENT, split, n_episodes)
    # What acts instead of a policy may have no modes.
    was_training, rng_state = getattr(policy, "training", None), get_rng_state()
    try:
        actor = make_actor(policy, processors, temperature, env.single_action_space.shape[0])
        actor.seed(ranks.own_seed(seed))
        own = chains[ranks.rank :: ranks.count]
        runner = ChainRunner(env, actor, Rules(window), states=states)
        results = runner.run(own, split, sampling_seed(seed, INDEPENDENT, split)) if own else []
    finally:
        if was_training is not None:
            policy.train(was_training)
        set_rng_state(rng_state)
    by_chain = {result.chain: result for some in ranks.gather(results) for result in some}
    return [by_chain[chain] for chain in chains]


def evaluate_independent(
    env: Any, policy: Any, *args: Any, seed: int, repetitions: int = 1, **options: Any
) -> dict[str, Any]:
    """The episodes of `run_independent` in numbers.

    Args:
        env: as there, and so are the others.
        policy: as there.
        args: as there.
        seed: of the sampling; each repetition has the next one.
        repetitions: episodes of each task and configuration. A policy that does not sample at the temperature,
            such as ACT, is not repeated: equal episodes would narrow its interval.
        options: as there.

    Returns:
        `split`, `temperature` (None for a policy without), `steps` (control steps of all episodes), `episodes`
        (each in short, for paired comparisons: seed, task, configuration, success) and `independent_results`.
    """
    split, temperature = options["split"], options["temperature"] if samples(policy) else None
    seeds = range(seed, seed + (repetitions if temperature else 1))
    episodes = [
        episode
        for s in seeds
        for episode in describe_episodes(run_independent(env, policy, *args, seed=s, **options), s)
    ]
    header = {
        "split": split,
        "temperature": temperature,
        "steps": sum(episode["steps"] for episode in episodes),
        "episodes": [[e[name] for name in ("seed", "number", "configuration", "length")] for e in episodes],
    }
    return header | numbers_of(INDEPENDENT, episodes, benchmark_of(env), split)
