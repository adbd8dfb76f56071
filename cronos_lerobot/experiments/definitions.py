"""Experiments as data: which training runs make up each table and figure of the paper."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import yaml

PAPER, WIDE, ONE = "paper", "wide", "one_configuration"
"""Base policies by where their demonstrations begin: in the 64 training configurations, as the paper's do; all
over the reach of the arm and in the middle of streams; in the first training configuration alone."""

SHORT, LONG = 1_300_000, 2_900_000
"""S of the paper's two kinds of run [interaction steps]: Sections 6.1 to 6.4 and 6.6, and Sections 6.5 and 6.7."""


@dataclass(frozen=True)
class Row:
    """One way of training: a row of the table, a line of the figure."""

    name: str
    """What `--rows` and folders call it."""
    flags: tuple[str, ...]
    """Flags of `cronos-train`, `--name=value` each. `{0.5}` stands for half of the run's steps."""
    base: str = PAPER
    """The base policy that it begins with: paper, wide or one_configuration."""

    @property
    def label(self) -> str:
        """What tables and figures call it, such as `T = 1280, EER, CL`."""
        from cronos_lerobot.protocol import ProtocolConfig
        from cronos_lerobot.protocol.streams import STEPS_PER_TASK
        from cronos_lerobot.report.runs import describe_protocol

        given = dict(flag.removeprefix("--").split("=", 1) for flag in self.flags)
        protocol = {name: value for name, value in given.items() if name.startswith("protocol.")}
        own = {name.removeprefix("protocol."): _value(value) for name, value in protocol.items()}
        others = [
            f"{name.rpartition('.')[2]}={value}" for name, value in given.items() if name.startswith("algorithm.")
        ]
        return ", ".join([describe_protocol(asdict(ProtocolConfig(STEPS_PER_TASK)) | own), *others])


def _value(text: str) -> Any:
    """A flag's value. That of a curriculum, which has a share of the steps, stays a text."""
    return text if "{" in text else yaml.safe_load(text)


@dataclass(frozen=True)
class Experiment:
    """A table or figure of the paper, or your own."""

    name: str
    title: str
    rows: tuple[Row, ...]
    source: str = ""
    """Where the paper has it; empty for your own."""
    steps: int = SHORT
    """S [interaction steps, all streams together]: SHORT or LONG; scales shorten both."""
    scene: str = "kitchen_2x2"
    budgets: tuple[int, ...] = ()
    """Numbers of interventions, of a run with the paper's steps, at which success is measured."""
    held_out_curve: bool = False
    """Evaluate every checkpoint on held-out configurations, or the last one alone."""
    suites: tuple[str, ...] = ("independent",)
    """Suites of `cronos-eval` for the last checkpoint."""
    paper: tuple[tuple[float, float], ...] = ()
    """The paper's success at the end of each row: mean and standard deviation over five seeds."""

    def __post_init__(self) -> None:
        names = [row.name for row in self.rows]
        if len(set(names)) < len(names):
            raise ValueError(f"the rows of experiment {self.name!r} need different names, got {names}.")


def _row(name: str, interval: int | None, *flags: str, eer: bool = True, base: str = PAPER) -> Row:
    every = f"--protocol.scene_reset_interval={'null' if interval is None else interval}"
    return Row(name, (every, f"--protocol.end_effector_reset={str(eer).lower()}", *flags), base)


CL = "--protocol.curriculum=[[{0.5},320]]"
"""T = 320 up to 0.65 M of 1.3 M interaction steps (Table 1, Section 6.3)."""
LSR, HSR = "--protocol.learned_reset=true", "--protocol.heuristic_reset=true"
ONE_CONFIGURATION = ("--protocol.num_configurations=1", "--eval.n_episodes=1", "--eval.repetitions=64")
"""As many episodes from the one configuration as from all 64."""

EPISODIC = _row("t80", 80, eer=False)
PERIODIC = _row("t320_eer", 320)
BEST = _row("t1280_eer_cl_hsr", 1280, CL, HSR)
"""The row that Sections 6.4 and 6.5 go on with."""
TABLE1 = (
    EPISODIC,
    _row("t1280", 1280, eer=False),
    _row("t1280_eer", 1280),
    _row("t1280_eer_cl", 1280, CL),
    _row("t1280_eer_cl_lsr", 1280, CL, LSR),
    BEST,
    _row("t1280_eer_cl_lsr_hsr", 1280, CL, LSR, HSR),
)
FEW_RESETS = (
    "--protocol.reset_phase=staggered",
    "--protocol.curriculum=[[{0.19},320]]",
    "--algorithm.kl_decay_updates=10",
)
"""Most resets early, each stream at a time of its own: 1,008 in 1.3 M interaction steps."""

EXPERIMENTS: dict[str, Experiment] = {}
"""Experiments by name. Runs with the same settings are shared between them."""


def register_experiment(experiment: Experiment) -> None:
    """Make an experiment known to `cronos-reproduce --discover_packages_path=MODULE`.

    Raises:
        ValueError: the name is taken.
    """
    if experiment.name in EXPERIMENTS:
        raise ValueError(f"there is an experiment {experiment.name!r} already")
    EXPERIMENTS[experiment.name] = experiment


for _experiment in (
    Experiment(
        "table1",
        "Performance of RF-MTRL approaches",
        TABLE1,
        "Table 1, Sections 6.1-6.3; by task: Figure 12",
        budgets=(1000, 1600, 2000, 6000),
        paper=(
            (0.897, 0.027),
            (0.023, 0.030),
            (0.326, 0.179),
            (0.578, 0.054),
            (0.580, 0.036),
            (0.649, 0.090),
            (0.631, 0.065),
        ),
    ),
    Experiment(
        "figure2",
        "Impact of task ordering",
        (BEST, _row("t1280_eer_cl_hsr_random", 1280, CL, HSR, "--protocol.task_order=random")),
        "Figure 2, Section 6.4; by task: Figure 14",
        held_out_curve=True,
    ),
    Experiment(
        "figure3",
        "Learning efficiency under varying reset budgets",
        (EPISODIC, PERIODIC, BEST, _row("t2560_eer_cl_hsr", 2560, CL, HSR)),
        "Figure 3, Section 6.5; by task: Figure 11",
        steps=LONG,
        budgets=(1000, 2000, 4000, 8000),
        suites=("independent", "sequential"),
    ),
    Experiment(
        "figure4",
        "Robustness to OOD object-receptacle configurations",
        (
            EPISODIC,
            PERIODIC,
            _row("t80_1config", 80, *ONE_CONFIGURATION, eer=False, base=ONE),
            _row("t320_eer_1config", 320, *ONE_CONFIGURATION, base=ONE),
        ),
        "Figure 4, Section 6.6; by task: Figure 13",
        held_out_curve=True,
    ),
    Experiment(
        "figure5",
        "Robustness to OOD task sequences",
        (EPISODIC, PERIODIC),
        "Figure 5, Section 6.6",
        suites=("independent", "sequential"),
    ),
    Experiment(
        "figure7",
        "Performance of a more complex task suite",
        (EPISODIC, PERIODIC),
        "Figure 7, Section 6.7",
        steps=LONG,
        scene="kitchen_3x3",
        budgets=(2000, 4000, 9000),
    ),
    Experiment(
        "figure8",
        "Learning efficiency under varying reset budgets, another scene",
        (EPISODIC, PERIODIC),
        "Figure 8, Appendix B",
        steps=LONG,
        scene="playroom_2x2",
    ),
    Experiment(
        "baselines",
        "The benchmark's baselines, from the official base policy",
        (
            _row("t80", 80, eer=False, base=WIDE),
            _row("t1280", 1280, eer=False, base=WIDE),
            _row("t1280_eer", 1280, base=WIDE),
            _row("t1280_eer_cl_hsr", 1280, CL, HSR, base=WIDE),
            _row("few_resets", 4400, *FEW_RESETS, base=WIDE),
        ),
        suites=("independent", "sequential", "stream"),
    ),
):
    register_experiment(_experiment)


def find_rows(experiment: Experiment, names: list[str]) -> tuple[Row, ...]:
    """The rows called `names`, or all of them if there are no names.

    Raises:
        ValueError: the experiment has no such row.
    """
    rows = {row.name: row for row in experiment.rows}
    if unknown := [name for name in names if name not in rows]:
        raise ValueError(f"--rows: {experiment.name} has no row {unknown[0]!r}; it has {', '.join(rows)}.")
    return tuple(rows[name] for name in names) or experiment.rows
