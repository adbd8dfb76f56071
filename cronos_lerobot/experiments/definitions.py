"""Experiments as data, and the paper's: which runs make up each table and figure (Sections 6, B and G)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from cronos_lerobot.experiments.flags import DROPS_CHECKPOINTS, RESERVED

INTERACTION_STEPS, INTERVENTIONS = "interaction_steps", "interventions"
SUITES, BOTH = ("independent", "sequential"), ("train", "held_out")
"""Suites and splits of the environment's package, which takes seconds to import."""

NARROW = "narrow"
"""The base policy whose demonstrations begin in the scene's 64 training configurations, as the paper's do."""

CURRICULUM_INTERVAL = 320
"""T of the paper's curriculum up to half of S: 0.65 M of 1.3 M interaction steps (Table 1, Section 6.3)."""

SHORT, LONG = 1_300_000, 2_900_000
"""S of the paper's two kinds of run [interaction steps]: Sections 6.1-6.4 and 6.6, and "to ensure convergence"
Sections 6.5 and 6.7."""


PACED = "--protocol.scene_reset=critic"
"""With it a budget is paced over the whole run and does not end it."""


def _check_tuple(name: str, value: Any, valid: list[str] | None = None) -> None:
    """Raise a ValueError, if `value` is neither tuple nor list, or is not of what is `valid`."""
    # ("held_out") is a word, whose letters would be taken one by one.
    if not isinstance(value, (tuple, list)):
        raise ValueError(f"{name} must be a tuple, such as ({value!r},), got {value!r}.")
    if valid is not None and not (value and set(value) <= set(valid)):
        raise ValueError(f"{name} must be some of {valid}, got {value!r}.")


def _check_word(name: str, value: str) -> None:
    """Raise a ValueError, if `value` is no part of a folder's name."""
    if not re.fullmatch(r"[\w.+-]+", value):
        raise ValueError(
            f"{name} is part of a folder's name, one word of letters, digits and _.+-, got {value!r}."
        )


def _is_pair(value: Any) -> bool:
    return isinstance(value, (tuple, list)) and len(value) == 2


@dataclass(frozen=True)
class Row:
    """One way of training: a row of the table, a line of the figure."""

    interval: int | None
    """T: control steps of one stream between two scene resets; None: there are no periodic ones."""
    end_effector_reset: bool = False
    """EER: the arm goes home at every task switch."""
    curriculum: bool = False
    """CL: T = 320 at first."""
    learned_reset: bool = False
    """LSR: tasks alternate with learned reset tasks."""
    heuristic_reset: bool = False
    """HSR: bodies that left the workspace are put back."""
    task_order: str = "heuristic"
    """heuristic or random."""
    num_configurations: int = 64
    """Training configurations, 64 or 1."""
    stages: tuple[tuple[int, int], ...] = ()
    """Another curriculum: up to how many steps of a run with the paper's steps, and T until then; scaled as the
    steps."""
    tag: str = ""
    """What else tells the row from the others, one word; needed with `stages`, `flags` and `budgets`."""
    flags: tuple[str, ...] = ()
    """More flags of `cronos-train`."""
    budgets: tuple[tuple[str, int], ...] = ()
    """More flags whose values are numbers of interventions in a run of the paper's steps: scaled as the steps."""
    base: str = NARROW
    """Which base policy it begins with, by its demonstrations; see `scales.BASE_KINDS`."""

    def __post_init__(self) -> None:
        if wrong := [flag for flag in self.flags if not flag.startswith("--") or "=" not in flag]:
            raise ValueError(f"flags of a row are --name=value, one word each, got {wrong[0]!r}.")
        # Its runs may be evaluated on another split while they train.
        reserved = [name for name in RESERVED if name != "--eval.split"]
        if taken := [flag for flag in self.flags if flag.split("=")[0] in reserved]:
            raise ValueError(f"{taken[0]} is set by the experiment: it cannot be among the flags of a row.")
        if self.num_configurations < 1:
            raise ValueError(f"num_configurations of a row must be at least 1, got {self.num_configurations}.")
        if self.tag:
            _check_word("the tag of a row", self.tag)
        for name in ("stages", "budgets"):
            if wrong := [pair for pair in getattr(self, name) if not _is_pair(pair)]:
                raise ValueError(f"{name} of a row are pairs, each in a tuple of its own, got {wrong[0]!r}.")
        if self.curriculum and self.stages:
            raise ValueError(f"a row has the paper's curriculum or stages of its own, {self.stages}, not both.")
        if self.num_configurations != 64 and self.base != NARROW:
            raise ValueError(
                f"a row of {self.num_configurations} configuration has a base of its own, not {self.base!r}."
            )

    @property
    def name(self) -> str:
        """How `--rows` and the run's folder call it, such as `t1280_eer_cl_hsr`."""
        words = [f"t{self.interval}" if self.interval else "tnone", *(word.lower() for word in self.aids)]
        if self.task_order != "heuristic":
            words.append(self.task_order)
        if self.num_configurations != 64:
            words.append(f"{self.num_configurations}config")
        words += [self.tag] if self.tag else []
        words += [self.base] if self.base != NARROW else []
        return "_".join(words)

    @property
    def label(self) -> str:
        """How figures call it, such as `T = 1280, EER, CL, HSR`."""
        words = [f"T = {self.interval}" if self.interval else "no T", *self.aids]
        if self.task_order != "heuristic":
            words.append(f"{self.task_order} order")
        if self.num_configurations != 64:
            words.append(f"{self.num_configurations} configuration{'s' * (self.num_configurations > 1)}")
        words += [self.tag.replace("_", " + ")] if self.tag else []
        words += [f"{self.base.replace('_', ' ')} base"] if self.base != NARROW else []
        return ", ".join(words)

    def begins_with(self, scene: str) -> Base:
        """The base policy of its runs in a scene."""
        return Base(scene, self.num_configurations, self.base)

    @property
    def has_budget(self) -> bool:
        """Whether a budget of interventions may end its runs before their last step: one that is not paced."""
        given = (*self.flags, *(name for name, _ in self.budgets))
        return PACED not in given and any(flag.split("=")[0] == "--protocol.reset_budget" for flag in given)

    @property
    def aids(self) -> list[str]:
        """The abbreviations of Table 1's columns that are ticked."""
        ticks = {
            "EER": self.end_effector_reset,
            "CL": self.curriculum,
            "LSR": self.learned_reset,
            "HSR": self.heuristic_reset,
        }
        return [name for name, ticked in ticks.items() if ticked]


@dataclass(frozen=True)
class Base:
    """Which base policy runs begin with."""

    scene: str
    configurations: int = 64
    """Rows that train on fewer have one that is cloned from those."""
    kind: str = NARROW
    """See `scales.BASE_KINDS`."""

    @property
    def recipe(self) -> str:
        """Name of its recipe in `Options.recipes`."""
        return self.scene if self.kind == NARROW else f"{self.scene}_{self.kind}"


@dataclass(frozen=True)
class CheckpointEvaluation:
    """An evaluation by `cronos-eval`, on top of the periodic ones while training."""

    suite: str
    """independent or sequential."""
    splits: tuple[str, ...]
    """train, held_out or both."""
    every_checkpoint: bool = False
    """Every checkpoint of a run, for curves, or its last one only."""

    def __post_init__(self) -> None:
        if self.suite not in SUITES:
            raise ValueError(f"suite of an evaluation must be one of {list(SUITES)}, got {self.suite!r}.")
        _check_tuple(f"splits of the {self.suite} evaluation", self.splits, list(BOTH))


@dataclass(frozen=True)
class Experiment:
    """A table or figure of the paper, or one's own."""

    name: str
    title: str
    rows: tuple[Row, ...]
    source: str = ""
    """Where the paper has it; empty if it is one's own."""
    steps: int = SHORT
    """S [interaction steps, all streams together]."""
    scene: str = "kitchen_2x2"
    axes: tuple[str, ...] = (INTERACTION_STEPS, INTERVENTIONS)
    """What the curves are drawn against."""
    by_task: bool = False
    """One panel for each task, or all tasks together."""
    splits: tuple[str, ...] = ("train",)
    """Configurations that the curves are measured on; those of held_out need `evaluations`."""
    evaluations: tuple[CheckpointEvaluation, ...] = ()
    budgets: tuple[int, ...] = (1000, 2000, 4000, 8000)
    """Numbers of interventions, of a run with the paper's steps, at which success is given."""
    by_base: bool = False
    """Its first figure has success against interventions on a logarithmic axis, a line of panels for each kind of
    base policy."""
    joined: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Of that figure: what a line joins the ends of, as its label and the names of its rows."""

    def __post_init__(self) -> None:
        _check_word("the name of an experiment", self.name)
        for name, valid in (("axes", [INTERACTION_STEPS, INTERVENTIONS]), ("splits", list(BOTH))):
            _check_tuple(f"{name} of {self.name}", getattr(self, name), valid)
        for name in ("rows", "evaluations", "budgets", "joined"):
            _check_tuple(f"{name} of {self.name}", getattr(self, name))
        if self.steps not in (SHORT, LONG):
            raise ValueError(f"steps of {self.name} must be SHORT={SHORT} or LONG={LONG}, got {self.steps}.")
        for line in self.joined:
            if not _is_pair(line):
                raise ValueError(f"joined of {self.name} are pairs, (label, names of rows), got {line!r}.")
            label, names = line
            _check_tuple(f"joined {label!r} of {self.name}", names, [row.name for row in self.rows])
        self._check_evaluations()

    def _check_evaluations(self) -> None:
        has_held_out = any(e.suite == "independent" and "held_out" in e.splits for e in self.evaluations)
        # A row may have its runs evaluated there while they train.
        has_held_out |= any("--eval.split=held_out" in row.flags for row in self.rows)
        if "held_out" in self.splits and not has_held_out:
            raise ValueError(
                f"splits of {self.name} have 'held_out', and no evaluation measures it: give evaluations="
                "(CheckpointEvaluation('independent', ('held_out',), every_checkpoint=True),)."
            )
        for row in self.rows if self.evaluations else ():
            if dropping := [flag for flag in row.flags if flag.startswith(DROPS_CHECKPOINTS)]:
                raise ValueError(
                    f"{self.name}: {dropping[0]} of {row.name} drops checkpoints, which are evaluated."
                )
        early = [row.name for row in self.rows if row.has_budget]
        if early and any(evaluation.every_checkpoint for evaluation in self.evaluations):
            raise ValueError(
                f"{self.name}: a budget may end runs of {', '.join(early)} at any checkpoint, so evaluations of"
                " every one cannot be planned: leave every_checkpoint out."
            )


EPISODIC = Row(80)
PERIODIC = Row(320, end_effector_reset=True)
BEST = Row(1280, end_effector_reset=True, curriculum=True, heuristic_reset=True)
"""The row that Sections 6.4 and 6.5 go on with."""
TABLE1_ROWS = (
    EPISODIC,
    Row(1280),
    Row(1280, end_effector_reset=True),
    Row(1280, end_effector_reset=True, curriculum=True),
    Row(1280, end_effector_reset=True, curriculum=True, learned_reset=True),
    BEST,
    Row(1280, end_effector_reset=True, curriculum=True, learned_reset=True, heuristic_reset=True),
)
ORDER_ROWS = (BEST, Row(1280, True, True, heuristic_reset=True, task_order="random"))
BUDGET_ROWS = (EPISODIC, PERIODIC, BEST, Row(2560, True, True, heuristic_reset=True))
CONFIGURATION_ROWS = (EPISODIC, PERIODIC, Row(80, num_configurations=1), Row(320, True, num_configurations=1))

HELD_OUT_CURVE = CheckpointEvaluation("independent", ("held_out",), every_checkpoint=True)

_ALL = (
    Experiment(
        "table1",
        "Performance of RF-MTRL approaches",
        TABLE1_ROWS,
        "Table 1, Sections 6.1-6.3",
        budgets=(1000, 1600, 2000, 6000),
    ),
    Experiment("figure2", "Impact of task ordering", ORDER_ROWS, "Figure 2, Section 6.4"),
    Experiment(
        "figure3",
        "Learning efficiency under varying reset budgets",
        BUDGET_ROWS,
        "Figure 3, Section 6.5",
        steps=LONG,
        evaluations=(CheckpointEvaluation("sequential", ("train",)),),
    ),
    Experiment(
        "figure4",
        "Robustness to OOD object-receptacle configurations",
        CONFIGURATION_ROWS,
        "Figure 4, Section 6.6",
        axes=(INTERACTION_STEPS,),
        splits=BOTH,
        evaluations=(HELD_OUT_CURVE,),
    ),
    Experiment(
        "figure5",
        "Robustness to OOD task sequences",
        (EPISODIC, PERIODIC),
        "Figure 5, Section 6.6",
        evaluations=(CheckpointEvaluation("sequential", BOTH),),
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
        "figure11",
        "Learning efficiency under varying reset budgets, by task",
        BUDGET_ROWS,
        "Figure 11, Appendix G",
        steps=LONG,
        by_task=True,
    ),
    Experiment(
        "figure12",
        "Performance of RF-MTRL approaches, by task",
        TABLE1_ROWS,
        "Figure 12, Appendix G",
        by_task=True,
        splits=BOTH,
        evaluations=(HELD_OUT_CURVE,),
    ),
    Experiment(
        "figure13",
        "Robustness to OOD object-receptacle configurations, by task",
        CONFIGURATION_ROWS,
        "Figure 13, Appendix G",
        axes=(INTERACTION_STEPS,),
        by_task=True,
        splits=BOTH,
        evaluations=(HELD_OUT_CURVE,),
    ),
    Experiment(
        "figure14",
        "Robustness to OOD task sequences, by task",
        ORDER_ROWS,
        "Figure 14, Appendix G",
        by_task=True,
        splits=BOTH,
        evaluations=(HELD_OUT_CURVE,),
    ),
)
PAPER_BUDGETS = {
    steps: tuple(
        sorted({budget for experiment in _ALL if experiment.steps == steps for budget in experiment.budgets})
    )
    for steps in (SHORT, LONG)
}
"""Numbers of interventions at which runs of so many of the paper's steps are evaluated, whoever shares them."""
EXPERIMENTS: dict[str, Experiment] = {experiment.name: experiment for experiment in _ALL}
"""Experiments by name. Runs with the same settings are shared between them."""


COMMANDS = ("all", "list", "status")
"""Words of `cronos-reproduce` that stand in the place of an experiment."""


def register_experiment(experiment: Experiment) -> None:
    """Add an experiment of one's own; `cronos-reproduce --import=MODULE` imports the module that calls this.

    Raises:
        ValueError: the name is taken, two rows of it have the same name, or a row has no tag where its name would
            be that of another, and with it the folder of its runs.
    """
    names = [row.name for row in experiment.rows]
    if experiment.name in COMMANDS:
        raise ValueError(f"{experiment.name!r} is a word of cronos-reproduce's own: {', '.join(COMMANDS)}")
    if experiment.name in EXPERIMENTS:
        raise ValueError(f"there is an experiment {experiment.name!r} already")
    for row in experiment.rows:
        untold = [name for name in ("flags", "stages", "budgets") if getattr(row, name)]
        if untold and not row.tag:
            raise ValueError(
                f"the row {row.name} of {experiment.name} has {', '.join(untold)} and no tag: its runs would lie "
                "in the folder of the row without them. Give it a tag, one word that names them."
            )
    if not names or len(set(names)) < len(names):
        raise ValueError(f"the rows of an experiment need different names (`tag` makes them so), got {names}")
    EXPERIMENTS[experiment.name] = experiment


def find_rows(experiment: Experiment, names: list[str]) -> tuple[Row, ...]:
    """The rows called `names`, each once, all of them if it is empty.

    Raises:
        ValueError: the experiment has no such row.
    """
    rows = {row.name: row for row in experiment.rows}
    for name in names:
        if name not in rows:
            raise ValueError(f"{experiment.name} has no row {name!r}; it has {', '.join(rows)}")
    return tuple(rows[name] for name in dict.fromkeys(names)) or experiment.rows
