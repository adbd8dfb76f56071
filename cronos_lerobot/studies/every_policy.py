"""Does every kind of policy learn without resets? Clones four with `lerobot-train`, trains each with each agent.

    python -m cronos_lerobot.studies.every_policy --output_dir=outputs/every_policy

From the privileged state of kitchen_2x2: one set of demonstrations, a base policy of each kind, and a run of
`cronos-train` for each agent, interval and seed, evaluated on the same 256 episodes before and after. It prints
both successes, the gain's 95 % interval over the seeds (Student's t), and what a step of training costs. All
commands lie beside what they made; the same command again goes on where this one was stopped, and `--report_only`
makes the tables of what there is. `gains.csv` has a line for each run of the folder, `gains.png` is drawn of
them; `--merge=gains.csv` adds another machine's.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_env_cronos import gymnasium_id

from cronos_lerobot.experiments.display import make_display
from cronos_lerobot.experiments.jobs import Job
from cronos_lerobot.experiments.plan import LAST_POLICY, resume_command
from cronos_lerobot.experiments.progress import train_progress
from cronos_lerobot.experiments.runner import DONE, Runner, usable_cores
from cronos_lerobot.report.png import to_png
from cronos_lerobot.report.runs import TrainingRun, read_training_run
from cronos_lerobot.studies.every_policy_report import (
    Cost,
    Ended,
    draw_gains,
    make_cost,
    make_cost_table,
    make_end,
    make_table,
    merge,
    read_gains,
    write_gains,
)
from cronos_lerobot.training.logging import METRICS

OBSERVATION = (
    "--env.type=cronos",
    "--env.obs_type=environment_state_agent_pos",
    "--env.task_observation=one_hot",
)
RESETS = {
    80: ("--protocol.scene_reset_interval=80",),
    320: ("--protocol.scene_reset_interval=320", "--protocol.end_effector_reset=true"),
}
"""T, the second with end-effector resets, as flags of `cronos-train`."""
MIN_MAX = {"VISUAL": "MEAN_STD", "STATE": "MIN_MAX", "ENV": "MIN_MAX"}
IMITATION = ("--algorithm.type=imitation",)
STEERING = ("--algorithm.type=steering",)


@dataclass(frozen=True)
class Kind:
    """A kind of policy, how its base is cloned, and how each agent trains it."""

    clone: tuple[str, ...]
    """Flags of `lerobot-train`."""
    clone_steps: int
    agents: dict[str, tuple[str, ...]]
    """Flags of `cronos-train`."""
    steps: dict[str, int] = field(default_factory=dict)
    """Interaction steps of an agent, where they are not `STEPS`."""


STEPS = 102_400
LARGE_MINIBATCHES = ("--algorithm.minibatch_size=2048",)
"""With which its results were made; today's default learns more (docs/trials.md)."""
KINDS = {
    "tokens": Kind(
        ("--policy.type=pocketvla",),
        320,
        {"ppo": LARGE_MINIBATCHES, "imitation": IMITATION},
        {"ppo": 204_800},
    ),
    "flow": Kind(
        ("--policy.type=pocketvla", "--policy.head=flow"),
        300,
        {
            "ppo": ("--algorithm.noise_level=0.3", "--algorithm.ratio=factor", *LARGE_MINIBATCHES),
            "imitation": IMITATION,
            "steering": STEERING,
        },
        {"ppo": 204_800},
    ),
    "act": Kind(
        (
            "--policy.type=act", "--policy.chunk_size=8", "--policy.n_action_steps=2", "--policy.dim_model=128",
            "--policy.n_heads=4", "--policy.dim_feedforward=512", "--policy.n_encoder_layers=1",
            "--policy.use_vae=false", "--policy.dropout=0", "--policy.optimizer_lr=1e-3",
            f"--policy.normalization_mapping={json.dumps(MIN_MAX | {'ACTION': 'MEAN_STD'})}",
        ),
        4000,
        {
            "ppo": ("--algorithm.noise_std=0.2", "--algorithm.ratio=factor", *LARGE_MINIBATCHES),
            "imitation": IMITATION,
        },
        {"ppo": 204_800},
    ),
    "diffusion": Kind(
        (
            "--policy.type=diffusion", "--policy.n_obs_steps=1", "--policy.horizon=8", "--policy.n_action_steps=4",
            "--policy.drop_n_last_frames=4", "--policy.down_dims=[64,128]", "--policy.kernel_size=3",
            "--policy.n_groups=8", "--policy.diffusion_step_embed_dim=64", "--policy.noise_scheduler_type=DDIM",
            "--policy.num_inference_steps=5", "--policy.prediction_type=sample", "--policy.optimizer_lr=1e-3",
            "--policy.scheduler_warmup_steps=50",
            f"--policy.normalization_mapping={json.dumps(MIN_MAX | {'ACTION': 'MIN_MAX'})}",
            "--dataset.streaming=true", "--num_workers=1",
        ),
        3000,
        {
            "ppo": (
                "--policy.n_action_steps=2", "--algorithm.noise_level=1", "--algorithm.noise_std=0.1",
                "--algorithm.ratio=factor", "--algorithm.value_epochs=10", "--algorithm.minibatch_size=512",
            ),
            "imitation": ("--policy.n_action_steps=2", *IMITATION),
            "steering": ("--policy.n_action_steps=2", *STEERING),
        },
        {"ppo": 204_800},
    ),
}  # fmt: skip
"""Sizes for two cores. Agents have the settings that a look at one seed found, none is tuned further."""


@dataclass(frozen=True)
class Run:
    """A training run of the study."""

    kind: str
    agent: str
    interval: int
    seed: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.kind}_{self.agent}_{self.interval}_{self.seed}"

    @property
    def steps(self) -> int:
        """S [interaction steps]."""
        return KINDS[self.kind].steps.get(self.agent, STEPS)


def make_runs(
    kinds: Sequence[str], agents: Sequence[str], intervals: Sequence[int], seeds: Sequence[int]
) -> list[Run]:
    """The runs, first one seed of all of them, then the next; an agent that cannot train a kind is left out."""
    return [
        Run(kind, agent, interval, seed)
        for seed in seeds
        for kind in kinds
        for agent in agents
        if agent in KINDS[kind].agents
        for interval in intervals
    ]


def make_jobs(runs: Sequence[Run], folder: Path) -> list[Job]:
    """Demonstrations, base policies and runs, in an order that goes."""
    environment = gymnasium_id("kitchen_2x2")
    dataset = ("--dataset.repo_id=local/demos", f"--dataset.root={folder / 'demos'}")
    record = (
        "cronos-record-demos", *OBSERVATION, *dataset, "--dataset.num_episodes=400", "--seed=1",
        "--noise.share=0.75", "--misses.share=0.25", "--steps_after_release=8",
    )  # fmt: skip
    jobs = [Job("demos", record, folder / "demos", environment=environment)]
    for name in dict.fromkeys(run.kind for run in runs):
        kind, output = KINDS[name], folder / "bases" / name
        workers = () if any(flag.startswith("--num_workers") for flag in kind.clone) else ("--num_workers=0",)
        clone = (
            "lerobot-train", *dataset, *kind.clone, *workers, "--policy.device=cpu", "--policy.push_to_hub=false",
            "--batch_size=256", f"--steps={kind.clone_steps}", f"--save_freq={kind.clone_steps}", "--seed=1",
            f"--output_dir={output}",
        )  # fmt: skip
        jobs.append(Job(f"base {name}", clone, output, needs=("demos",), environment=environment))
    return [*jobs, *(_run_job(run, folder, environment) for run in runs)]


def _run_job(run: Run, folder: Path, environment: str) -> Job:
    output, base = run_folder(run, folder), folder / "bases" / run.kind / LAST_POLICY
    command = (
        "cronos-train", f"--policy.path={base}", "--policy.device=cpu", *OBSERVATION, "--num_envs=64",
        "--torch_threads=1", "--env.num_threads=1", "--protocol.update_interval=160", *RESETS[run.interval],
        *KINDS[run.kind].agents[run.agent], "--eval.n_episodes=64", f"--steps={run.steps}",
        f"--eval_freq={run.steps}", f"--save_freq={STEPS // 2}", f"--seed={run.seed}", "--tensorboard=false",
        f"--output_dir={output}",
    )  # fmt: skip

    return Job(
        run.name,
        command,
        output,
        needs=(f"base {run.kind}",),
        resume=lambda: resume_command(output, command),
        progress=lambda: train_progress(output, run.steps),
        environment=environment,
        work=run.steps,
    )


def run_folder(run: Run, folder: Path) -> Path:
    """`--output_dir` of a run."""
    return folder / "runs" / run.name


def read_runs(folder: Path) -> dict[Run, TrainingRun]:
    """Runs of the study that have come to their first evaluation, whatever was asked for this time."""
    begun = {}
    for path in sorted(path.parent for path in (folder / "runs").glob(f"*_*_*_*/{METRICS}")):
        kind, agent, interval, seed = path.name.split("_")
        if kind in KINDS and (path / METRICS).read_bytes().count(b"\n"):
            begun[Run(kind, agent, int(interval), int(seed))] = read_training_run(path)
    return begun


def find_ends(begun: Mapping[Run, TrainingRun]) -> list[Ended]:
    """Those that are over."""
    found = (make_end(read, run.kind, run.agent, run.interval, run.seed, run.steps) for run, read in begun.items())
    return [end for end in found if end]


def find_costs(begun: Mapping[Run, TrainingRun]) -> dict[tuple[str, str], list[Cost]]:
    """By policy and agent."""
    costs: dict[tuple[str, str], list[Cost]] = {}
    for run, read in begun.items():
        if cost := make_cost(read):
            costs.setdefault((run.kind, run.agent), []).append(cost)
    return costs


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/every_policy"))
    parser.add_argument("--policies", nargs="+", choices=KINDS, default=list(KINDS))
    agents = list(dict.fromkeys(agent for kind in KINDS.values() for agent in kind.agents))
    parser.add_argument("--agents", nargs="+", choices=agents, default=agents)
    parser.add_argument("--intervals", nargs="+", type=int, choices=RESETS, default=list(RESETS), help="T")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="commands at a time")
    parser.add_argument("--report_only", action="store_true", help="run nothing")
    parser.add_argument(
        "--merge", type=Path, nargs="+", default=[], metavar="GAINS.CSV", help="report these runs, too"
    )
    args = parser.parse_args()
    runs = make_runs(args.policies, args.agents, args.intervals, args.seeds)
    jobs, done = make_jobs(runs, args.output_dir), True
    if not args.report_only:
        try:
            with make_display(jobs) as display:
                states = Runner(jobs, args.jobs, display, {"OMP_NUM_THREADS": "1"}).run()
        except KeyboardInterrupt:
            sys.exit("\ninterrupted: the same command goes on from here")
        done = all(state == DONE for state in states.values())
    others = [end for path in args.merge for end in read_gains(path)]
    begun = read_runs(args.output_dir)
    ends = merge(find_ends(begun), others, list(KINDS))
    if ends:
        args.output_dir.mkdir(parents=True, exist_ok=True)
        write_gains(ends, args.output_dir / "gains.csv")
        (args.output_dir / "gains.png").write_bytes(to_png(draw_gains(ends), 150))
    print(make_table(ends), make_cost_table(find_costs(begun)), sep="\n\n")
    if not done:
        sys.exit(1)


if __name__ == "__main__":
    main()
