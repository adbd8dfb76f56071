"""The README's table of results, made from the files of the experiments that it shows.

    python -m cronos_lerobot.studies.readme          # write it anew
    python -m cronos_lerobot.studies.readme --check  # only say whether it is what the files say

The files are those that `cronos-reproduce` wrote, in docs/results; the table stands between two marks.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cronos_lerobot.studies import marked_tables
from cronos_lerobot.studies.marked_tables import MarkedTable

EXPERIMENT = "few_resets_best"
RESULTS = Path(f"docs/results/{EXPERIMENT}_paper_state")
ROWS = {
    "t80_wide": "episodic: a reset every 80 steps",
    "t80_decay_wide": "episodic, with smaller and smaller updates",
    "t1280_eer_wide": "a reset every 1280 steps",
    "t1280_eer_cl_hsr_wide": "the paper's best: curriculum, lost bodies put back",
    "t1280_eer_cl_hsr_decay_wide": "the paper's best, with smaller and smaller updates",
    "t4400_eer_staggered_early_decay_wide": "few resets: most of them early, each stream at a time of its own,"
    " smaller and smaller updates",
    "t80_decay_wide_resets": "episodic, from a base that was shown reset tasks as well, in more demonstrations",
    "t1280_eer_cl_hsr_wide_resets": "the paper's best, from that base",
    "t4400_eer_staggered_early_decay_wide_resets": "few resets, from that base",
    "t4400_eer_lsr_staggered_early_decay_wide_resets": "few resets and learned ones, from that base",
}
"""What the README calls them; rows without a finished run are left out, and the first of the others from the same
base policy is what they are compared with."""
README = MarkedTable("few_resets", Path("README.md"), "cronos_lerobot.studies.readme")


def make_table(folder: Path) -> str:
    """The table in Markdown, of what `cronos-reproduce few_resets_best` wrote into a folder."""
    found = json.loads((folder / f"{EXPERIMENT}.json").read_text())
    rows = {row["row"]: row for row in found["rows"] if row["success_train_mean"] is not None}
    shown = [name for name in ROWS if name in rows]
    firsts = {rows[name]["base"]: name for name in reversed(shown)}
    differences = {one["row"]: one for one in found["differences"] if one["reference"] in firsts.values()}
    lines = [
        "| training | interventions | before | success | held out | seeds "
        "| minus the first row from that kind of base, on the seeds of both [95 %] |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in shown:
        row = rows[name]
        is_compared = name in differences and differences[name]["reference"] == firsts[row["base"]]
        cells = (
            ROWS[name],
            f"{row['interventions_mean']:,.0f}",
            f"{row['base_success_mean']:.3f}",
            _success(row, "train"),
            _success(row, "held_out"),
            str(row["seeds"]),
            _difference(differences[name]) if is_compared else "",
        )
        lines.append(f"| {' | '.join(cells)} |")
    steps, n = found["steps"], rows[shown[0]]["n_train"]
    return "\n".join([*lines, "", f"{steps:,} interaction steps; n = {n} for each seed."])


def _success(row: dict[str, Any], split: str) -> str:
    mean, std = row.get(f"success_{split}_mean"), row.get(f"success_{split}_std")
    if mean is None:
        return ""
    spread = "" if std is None else f" ± {std:.3f}"
    if row["seeds"] == 2:
        # Student's interval of two seeds is as good as none: no width if they are alike, or beyond 1.
        return f"{mean:.3f}{spread}"
    low, high = row[f"success_{split}_ci95_low"], row[f"success_{split}_ci95_high"]
    return f"{mean:.3f}{spread}" + _interval((low, None if high is None else min(high, 1.0)), ".3f")


def _difference(found: dict[str, Any]) -> str:
    text = f"{found['difference']:+.3f}" + _interval((found["ci95_low"], found["ci95_high"]), "+.3f")
    return text if found["of_trainings"] else f"{text}, these policies"


def _interval(ends: tuple[float | None, float | None], form: str) -> str:
    return "" if None in ends else f" [{ends[0]:{form}}, {ends[1]:{form}}]"


def main() -> None:
    """Entry point."""
    marked_tables.main(README, lambda: make_table(RESULTS), __doc__)


if __name__ == "__main__":
    main()
