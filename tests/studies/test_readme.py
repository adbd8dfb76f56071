"""The README shows what the files of the experiments say."""

import json
from pathlib import Path

import pytest

from cronos_lerobot.studies.readme import README, RESULTS, make_table

ROOT = Path(__file__).parents[2]
ROWS = [
    {
        "row": "t80_wide", "seeds": 2, "success_train_mean": 0.75, "success_train_std": 0.1,
        "success_train_ci95_low": 0.6, "success_train_ci95_high": 0.9, "n_train": 256, "base_success_mean": 0.4,
        "interventions_mean": 3840,
    },
    {
        "row": "t1280_eer_wide", "seeds": 1, "success_train_mean": 0.5, "success_train_std": None,
        "success_train_ci95_low": 0.45, "success_train_ci95_high": 0.55, "n_train": 256, "base_success_mean": 0.4,
        "interventions_mean": 192,
    },
    {"row": "t1280_eer_cl_hsr_wide", "seeds": 0, "success_train_mean": None},
]  # fmt: skip
DIFFERENCE = {
    "row": "t1280_eer_wide", "reference": "t80_wide", "difference": -0.25, "ci95_low": -0.5, "ci95_high": 0.0,
}  # fmt: skip


def test_the_table_by_hand(tmp_path):
    found = {"steps": 307_200, "rows": ROWS, "differences": [DIFFERENCE]}
    (tmp_path / "few_resets_best.json").write_text(json.dumps(found))
    table = make_table(tmp_path)
    assert table.splitlines()[2:] == [
        "| episodic: a reset every 80 steps | 3,840 | 0.750 ± 0.100 [0.600, 0.900] | 2 |  |",
        "| a reset every 1280 steps | 192 | 0.500 [0.450, 0.550] | 1 | -0.250 [-0.500, +0.000] |",
        "",
        "307,200 interaction steps; before training 0.400; n = 256 for each seed.",
    ]
    readme = f"# Title\n\n{README.begin}\nold\n{README.end}\n\nmore\n"
    assert README.rewrite(readme, table) == f"# Title\n\n{README.begin}\n{table}\n{README.end}\n\nmore\n"
    with pytest.raises(ValueError, match="once each"):
        README.rewrite("# Title", table)


def test_the_readme_is_what_the_files_say():
    readme = (ROOT / README.page).read_text()
    assert README.rewrite(readme, make_table(ROOT / RESULTS)) == readme
