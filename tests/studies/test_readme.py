"""The README shows what the files of the experiments say."""

import json
from pathlib import Path

import pytest

from cronos_lerobot.studies.readme import BEGIN, END, RESULTS, make_table, rewrite

ROOT = Path(__file__).parents[2]
CSV = """\
row,seeds,success_train_mean,success_train_std,success_train_ci95_low,success_train_ci95_high,n_train,\
base_success_mean,interventions_mean
t80_wide,2,0.75,0.1,0.6,0.9,256,0.4,3840
t1280_eer_wide,1,0.5,,0.45,0.55,256,0.4,192
t1280_eer_cl_hsr_wide,0,,,,,,,
"""
DIFFERENCES = "row,reference,difference,ci95_low,ci95_high\nt1280_eer_wide,t80_wide,-0.25,-0.3,-0.2\n"


def test_the_table_by_hand(tmp_path):
    (tmp_path / "few_resets.csv").write_text(CSV)
    (tmp_path / "few_resets_differences.csv").write_text(DIFFERENCES)
    (tmp_path / "few_resets.json").write_text(json.dumps({"steps": 307_200}))
    table = make_table(tmp_path)
    assert table.splitlines()[2:] == [
        "| episodic: a reset every 80 steps | 3,840 | 0.750 ± 0.100 [0.600, 0.900] | 2 |  |",
        "| a reset every 1280 steps | 192 | 0.500 [0.450, 0.550] | 1 | -0.250 [-0.300, -0.200] |",
        "",
        "307,200 interaction steps; before training 0.400; n = 256 for each seed.",
    ]
    readme = f"# Title\n\n{BEGIN}\nold\n{END}\n\nmore\n"
    assert rewrite(readme, tmp_path) == f"# Title\n\n{BEGIN}\n{table}\n{END}\n\nmore\n"
    with pytest.raises(ValueError, match="once each"):
        rewrite("# Title", tmp_path)


def test_the_readme_is_what_the_files_say():
    readme = (ROOT / "README.md").read_text()
    assert rewrite(readme, ROOT / RESULTS) == readme
