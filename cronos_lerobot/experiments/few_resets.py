"""Learning with few resets: the paper's aids and what this project adds, each alone, on two base policies.

A plug is a few flags of `cronos-train` beside T = 1280 with end-effector resets. A new one is one line of `PLUGS`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

from cronos_lerobot.experiments.definitions import (
    BEST,
    BOTH,
    EPISODIC,
    CheckpointEvaluation,
    Experiment,
    Row,
    register_experiment,
)
from cronos_lerobot.experiments.scales import WIDE, WIDE_RESETS

INTERVAL = 1280
"""T of the rows with few resets: a sixteenth of the resets of T = 80."""
BUDGET = 1016
"""B, a sixteenth of those of T = 80 in 1.3 M steps; staggered resets every 1280 steps spend as many."""
EARLY, EARLY_RESETS, LATE = 320, 768, 4400
"""Of `early`: T at first, as in the paper's curriculum; resets of all streams by then; T after them."""


@dataclass(frozen=True)
class Plug:
    """One way of learning more from few resets."""

    flags: tuple[str, ...]
    """Of `cronos-train`."""
    budgets: tuple[tuple[str, int], ...] = ()
    """Flags that are numbers of interventions in a run of the paper's steps."""
    interval: int | None = INTERVAL
    """T beside it, if that of no other plug is longer; None where it spends the budget itself."""
    stages: tuple[tuple[int, int], ...] = ()
    """See `Row`."""


PLUGS: dict[str, Plug] = {
    "critic": Plug(("--protocol.task_order=critic",)),
    "staggered": Plug(("--protocol.reset_phase=staggered",)),
    "asked": Plug(("--protocol.scene_reset=critic",), (("--protocol.reset_budget", BUDGET),), interval=None),
    "early": Plug((), interval=LATE, stages=((EARLY_RESETS * EARLY, EARLY),)),
    "decay": Plug(("--algorithm.kl_decay_updates=10",)),
    "learnable": Plug(("--protocol.reset_starts=learnable",)),
    "memory": Plug(("--algorithm.self_imitation.coef=0.05",)),
    "takeover": Plug(("--protocol.takeover_after=2",), (("--protocol.takeover_budget", BUDGET),), interval=None),
}
"""By the names that rows have."""
TOGETHER = ("staggered", "early", "decay")
"""The plugs of the row that has the best of them."""


def plugged(*names: str, interval: int | None = None) -> Row:
    """The row with these plugs, end-effector resets and T: `interval`, the plugs' own, or none beside a budget."""
    plugs = [PLUGS[name] for name in names]
    intervals = [plug.interval for plug in plugs if plug.interval]
    return Row(
        interval or max(intervals) if len(intervals) == len(plugs) else None,
        end_effector_reset=True,
        stages=tuple(stage for plug in plugs for stage in plug.stages),
        tag="_".join(names),
        flags=tuple(flag for plug in plugs for flag in plug.flags),
        budgets=tuple(budget for plug in plugs for budget in plug.budgets),
    )


def wide(row: Row) -> Row:
    """The row from the base policy whose demonstrations began all over the reach of the arm.

    Those of a row with learned resets have reset tasks among them.
    """
    return with_resets(row) if row.learned_reset else replace(row, base=WIDE)


def with_resets(row: Row) -> Row:
    """The row from the wide base policy that can do reset tasks, whether they are given or not."""
    return replace(row, base=WIDE_RESETS)


PLAIN = Row(INTERVAL, end_effector_reset=True)
CURRICULUM = Row(INTERVAL, end_effector_reset=True, curriculum=True)
AIDS = (
    EPISODIC,
    PLAIN,
    CURRICULUM,
    Row(INTERVAL, end_effector_reset=True, curriculum=True, learned_reset=True),
    BEST,
)
"""The paper's: Table 1's rows with end-effector resets."""
METHOD = plugged(*TOGETHER)
LEARNED = replace(METHOD, learned_reset=True)
"""Learned resets keep old scenes like fresh ones, if the base policy can do them."""
TAUGHT = plugged("takeover", "memory")
"""An expert's segments are cloned only where successes are kept."""
TUNED = Row(80, tag="decay", flags=PLUGS["decay"].flags)
BEST_TUNED = replace(BEST, tag="decay", flags=PLUGS["decay"].flags)
"""What settles the policy of few resets may settle those of T = 80 and of the paper's aids."""
ASKED = plugged("asked", "decay")
PAIRS = (TAUGHT, plugged("critic", "staggered"), plugged("staggered", "decay"), ASKED)
SCREENED = (*AIDS, *(plugged(name) for name in PLUGS), *PAIRS, METHOD, TUNED, BEST_TUNED)

METHOD_BY_BUDGET = (
    METHOD,
    replace(METHOD, interval=20_000, stages=((EARLY_RESETS // 4 * EARLY, EARLY),)),
    plugged("staggered", "decay", interval=20_240),
    replace(plugged("decay"), interval=None),
)
"""In 1.3 M steps of 64 streams these are 1,008, 254 and 64 resets, and none."""
LEARNED_BY_BUDGET = tuple(replace(row, learned_reset=True) for row in METHOD_BY_BUDGET)
"""The same with learned resets, which are no interventions."""
PAPER_BY_BUDGET = tuple(
    Row(interval, end_effector_reset=True, heuristic_reset=True) for interval in (1280, 5120, 10240, None)
)
"""All streams are reset 15 times, 3 times, once, never: 960, 192, 64 and 0, besides what HSR puts back."""

_BUDGETS = (1000, 2000, 6000)


def _names(rows: tuple[Row, ...]) -> tuple[str, ...]:
    return tuple(row.name for row in rows)


_BY_BUDGET = {
    " + ".join(TOGETHER): tuple(map(wide, METHOD_BY_BUDGET)),
    " + ".join((*TOGETHER, "LSR")): tuple(map(wide, LEARNED_BY_BUDGET)),
    "EER, HSR": tuple(map(wide, PAPER_BY_BUDGET)),
}
"""Ways of training with ever fewer interventions."""

for _experiment in (
    Experiment(
        "few_resets",
        "Learning with few resets",
        (
            *SCREENED,
            *(wide(row) for row in SCREENED if not row.learned_reset),
            *map(with_resets, (EPISODIC, CURRICULUM, METHOD, *(row for row in SCREENED if row.learned_reset))),
        ),
        budgets=_BUDGETS,
        by_base=True,
    ),
    Experiment(
        "few_resets_best",
        "Learning with few resets, evaluated in full",
        (
            *map(wide, (EPISODIC, TUNED, PLAIN, BEST, BEST_TUNED, METHOD, ASKED)),
            *map(with_resets, (TUNED, BEST, METHOD, LEARNED)),
        ),
        splits=BOTH,
        evaluations=(CheckpointEvaluation("independent", ("held_out",)), CheckpointEvaluation("sequential", BOTH)),
        budgets=_BUDGETS,
        by_base=True,
    ),
    Experiment(
        "few_resets_budgets",
        "Success against the budget of interventions",
        (
            *map(wide, (EPISODIC, TUNED, BEST, BEST_TUNED)),
            with_resets(TUNED),
            *chain.from_iterable(_BY_BUDGET.values()),
        ),
        budgets=(64, 254, 1000),
        by_base=True,
        joined=tuple((label, _names(rows)) for label, rows in _BY_BUDGET.items()),
    ),
    *(
        Experiment(
            f"few_resets_{scene}",
            f"Learning with few resets in {scene}",
            tuple(map(wide, (EPISODIC, PLAIN, METHOD))),
            scene=scene,
            budgets=_BUDGETS,
            by_base=True,
        )
        for scene in ("kitchen_3x3", "playroom_2x2")
    ),
):
    register_experiment(_experiment)
