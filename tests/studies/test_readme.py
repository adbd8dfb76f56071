"""The README shows what the files of the experiments say."""

import json
from pathlib import Path

import pytest

from cronos_lerobot.studies.readme import README, RESULTS, make_table

ROOT = Path(__file__).parents[2]


def make_row(name, base, seeds, interventions, before, **success):
    """A row as `cronos-reproduce` writes it; by split: mean, standard deviation, ends of the interval."""
    row = {"row": name, "base": base, "seeds": seeds, "interventions_mean": interventions, "n_train": 256}
    row |= {"base_success_mean": before, "success_train_mean": None}
    for split, values in success.items():
        names = ("mean", "std", "ci95_low", "ci95_high")
        row |= {f"success_{split}_{what}": value for what, value in zip(names, values, strict=True)}
    return row


ROWS = [
    make_row("t80_wide", "wide", 3, 3840, 0.4, train=(0.75, 0.1, 0.5, 1.0), held_out=(0.9, 0.05, 0.7, 1.1)),
    make_row("t1280_eer_wide", "wide", 1, 192, 0.4, train=(0.5, None, 0.45, 0.55)),
    make_row("t1280_eer_cl_hsr_wide", "wide", 0, None, None),
    make_row("t80_decay_wide_resets", "wide_resets", 2, 3840, 0.3, train=(0.8, 0.0, 0.8, 0.8)),
]
DIFFERENCES = [
    {"row": row, "reference": "t80_wide", "difference": -0.25, "ci95_low": -0.5, "ci95_high": 0.0}
    | {"of_trainings": False}
    for row in ("t1280_eer_wide", "t80_decay_wide_resets")
]


def test_the_table_by_hand(tmp_path):
    found = {"steps": 307_200, "rows": ROWS, "differences": DIFFERENCES}
    (tmp_path / "few_resets_best.json").write_text(json.dumps(found))
    table = make_table(tmp_path)
    assert table.splitlines()[2:] == [
        # An interval of a rate ends at 1.
        "| episodic: a reset every 80 steps | 3,840 | 0.400 | 0.750 ± 0.100 [0.500, 1.000] "
        "| 0.900 ± 0.050 [0.700, 1.000] | 3 |  |",
        "| a reset every 1280 steps | 192 | 0.400 | 0.500 [0.450, 0.550] |  | 1 "
        "| -0.250 [-0.500, +0.000], these policies |",
        # From another base, with which the first row does not compare.
        "| episodic, from a base that was shown reset tasks as well, in more demonstrations | 3,840 "
        "| 0.300 | 0.800 ± 0.000 |  | 2 |  |",
        "",
        "307,200 interaction steps; n = 256 for each seed.",
    ]
    readme = f"# Title\n\n{README.begin}\nold\n{README.end}\n\nmore\n"
    assert README.rewrite(readme, table) == f"# Title\n\n{README.begin}\n{table}\n{README.end}\n\nmore\n"
    with pytest.raises(ValueError, match="once each"):
        README.rewrite("# Title", table)


def test_the_readme_is_what_the_files_say():
    readme = (ROOT / README.page).read_text()
    assert README.rewrite(readme, make_table(ROOT / RESULTS)) == readme
