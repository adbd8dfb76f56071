"""The table of all experiments is made from their files."""

import json
from pathlib import Path

from cronos_lerobot.studies.claims import CLAIMS, RESULTS, make_table, read_experiments

ROOT = Path(__file__).parents[2]
ORDER = {"row": "t1280", "reference": "t80", "says": "lower", "where": "Section 6.1", "suite": "independent",
         "unit": "", "split": "train", "holds": "yes", "difference": -0.75, "ci95_low": -0.9, "ci95_high": -0.6,
         "of_trainings": False}  # fmt: skip
NOT_RUN = {"row": "t1280_eer", "reference": "t1280", "says": "higher", "split": "held_out", "holds": "not run"}
FOUND = {
    "experiment": "table1", "scene": "kitchen_2x2", "obs_type": "environment_state_agent_pos", "steps": 307_200,
    "hours": 1.25, "rows": [{"seeds": 3}, {"seeds": 1}, {"seeds": 0}],
    "orders": [ORDER, {"where": "Section 6.1", "suite": "independent"} | NOT_RUN],
}  # fmt: skip


def test_the_table_by_hand(tmp_path):
    (tmp_path / "table1_small").mkdir()
    (tmp_path / "table1_small/table1.json").write_text(json.dumps(FOUND))
    # Version 0's files say nothing of claims, few_resets' have none.
    (tmp_path / "few").mkdir()
    (tmp_path / "few/few_resets.json").write_text(json.dumps(FOUND | {"orders": []}))
    (tmp_path / "few/table1.json").write_text(json.dumps({"rows": []}))
    table = make_table(read_experiments(tmp_path))
    assert table.splitlines()[2:] == [
        "| table1, kitchen_2x2, state | 2 of 3 | 1–3 | 307,200 | 1.2 | t1280 below t80 (Section 6.1) |"
        " independent, train | -0.750 [-0.900, -0.600], these policies | yes |",
        "|  |  |  |  |  | t1280_eer above t1280 (Section 6.1) | independent, held-out | – | not run |",
    ]


def test_the_page_is_what_the_files_say():
    page = (ROOT / CLAIMS.page).read_text()
    assert CLAIMS.rewrite(page, make_table(read_experiments(ROOT / RESULTS))) == page
