"""The independent suite of a policy that is at hand: what `cronos-train` asks every now and then.

The same chains, random numbers and actors as `cronos-eval`'s.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from lerobot.utils.random_utils import get_rng_state, set_rng_state
from lerobot_env_cronos import SequentialVectorEnv

from cronos_lerobot.agents.base import samples
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.evaluation.actors import NOT_REPEATED, make_actor
from cronos_lerobot.evaluation.chains import ChainResult, ChainRunner
from cronos_lerobot.evaluation.plan import make_parts
from cronos_lerobot.evaluation.results import Record, independent_results
from cronos_lerobot.evaluation.store import chain_records
from cronos_lerobot.processes import Processes


def run_independent(
    env: SequentialVectorEnv,
    policy: Any,
    processors: PolicyProcessors,
    *,
    n_episodes: int,
    split: str,
    temperature: float,
    seed: int,
    processes: Processes | None = None,
    keeps_states: bool = False,
) -> tuple[list[ChainResult], bool]:
    """Run every task of the environments' benchmark with a policy, and leave everything else as it was.

    An episode's random numbers are those of the episode and the step. If the policy takes them (`uniform`, see
    `TrainablePolicy`), its episodes do not depend on the number of environments and processes. One that draws from
    a generator gives the same result at the same number of both.

    Args:
        env: environments of the evaluation's own, never those of a training stream.
        policy: a LeRobot policy on its device, or what acts in its place by `sample_actions`.
        processors: between `env` and `policy`.
        n_episodes: configurations of every task, the first ones.
        split: `train` or `held_out`.
        temperature: of the sampling, 0 for the likeliest action.
        seed: of the sampling.
        processes: that share out the episodes; all call this and get the whole result.
        keeps_states: return the trajectories, too.

    Returns:
        The episodes, task by task, and whether any randomness was drawn for them: if not, another seed would give
        the same ones.
    """
    processes = processes or Processes()
    (part,) = make_parts(env.benchmark, ["independent"], [split], n_episodes, 0)
    env.split = split
    # What acts in a policy's place may have no modes.
    was_training, rng_state = getattr(policy, "training", None), get_rng_state()
    try:
        actor = make_actor(policy, processors, temperature)
        actor.seed(processes.own_seed(seed))
        own = part.chains[processes.rank :: processes.count]
        results = ChainRunner(env, actor, keeps_states=keeps_states).run(own, part.noise(seed))
        # Before the global generators are set back.
        drew = actor.drew
    finally:
        if was_training is not None:
            policy.train(was_training)
        set_rng_state(rng_state)
    gathered = processes.gather((results, drew))
    by_chain = {result.chain: result for some, _ in gathered for result in some}
    return [by_chain[chain] for chain in part.chains], any(has_drawn for _, has_drawn in gathered)


def episode_lists(by_seed: Mapping[int, Sequence[Record]]) -> list[list[int]]:
    """Every episode in short, for comparisons in pairs: [seed, task, configuration, success]."""
    return [
        [seed, record["number"], record["configuration"], record["length"]]
        for seed, records in by_seed.items()
        for record in records
    ]


def evaluate_independent(
    env: SequentialVectorEnv, policy: Any, *args: Any, seed: int, repetitions: int = 1, **options: Any
) -> dict[str, Any]:
    """The episodes of `run_independent` in numbers.

    Of a policy that draws nothing, as ACT, an episode is not repeated: it would be the same one.

    Args:
        env: as there, and so are the others.
        policy: as there.
        args: as there.
        seed: of the sampling; a repetition has the next one.
        repetitions: episodes of each task and configuration.
        options: as there.

    Returns:
        `split`, `temperature` (None of a policy that has none), `steps` (control steps of all episodes),
        `episodes` (see `episode_lists`) and `independent_results`.
    """
    by_seed = {}
    for s in range(seed, seed + repetitions):
        results, drew = run_independent(env, policy, *args, seed=s, **options)
        by_seed[s] = chain_records(results)
        if not drew and repetitions > 1:
            logging.warning(NOT_REPEATED, repetitions)
            break
    records = [record for some in by_seed.values() for record in some]
    groups = env.benchmark.groups("independent", options["split"])
    temperature = options["temperature"] if samples(policy) else None
    header = {"split": options["split"], "temperature": temperature}
    header |= {"steps": sum(record["steps"] for record in records), "episodes": episode_lists(by_seed)}
    return header | independent_results(records, [group.tasks[0] for group in groups])
