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
    "hours": 1.25, "seeds": [1, 2, 3, 4, 5], "rows": [{"seeds": 3}, {"seeds": 1}, {"seeds": 0}],
    "orders": [ORDER, {"where": "Section 6.1", "suite": "independent"} | NOT_RUN],
}  # fmt: skip


def test_the_table_by_hand(tmp_path):
    (tmp_path / "table1_small").mkdir()
    (tmp_path / "table1_small/table1.json").write_text(json.dumps(FOUND))
    # Version 0's files say nothing of claims, few_resets is none of the paper's, figure 12 has no sentences.
    (tmp_path / "few").mkdir()
    (tmp_path / "few/few_resets.json").write_text(json.dumps(FOUND | {"experiment": "few_resets", "orders": []}))
    (tmp_path / "few/table1.json").write_text(json.dumps({"rows": []}))
    (tmp_path / "figure12").mkdir()
    by_task = {"experiment": "figure12", "rows": [{"seeds": 5}], "orders": []}
    (tmp_path / "figure12/figure12.json").write_text(json.dumps(FOUND | by_task))
    table = make_table(read_experiments(tmp_path))
    assert table.splitlines()[2:6] == [
        "| table1, kitchen_2x2, state | 2 of 3 | 1–3 of 5 | 307,200 | 1.2 | t1280 below t80 (Section 6.1) |"
        " independent, train | -0.750 [-0.900, -0.600], these policies | yes |",
        "|  |  |  |  |  | t1280_eer above t1280 (Section 6.1) | independent, held-out | – | not run |",
        "| figure2, kitchen_2x2 | 0 of 2 | – | – | – | 1 sentence | – | – | not run |",
        "| figure3, kitchen_2x2 | 0 of 4 | – | – | – | 3 sentences | – | – | not run |",
    ]
    rest = [line.split(" | ") for line in table.splitlines()[6:]]
    assert [line[0][2:].split(",")[0] for line in rest] == [f"figure{n}" for n in (4, 5, 7, 8, 11, 12, 13, 14)]
    assert [line[-1] for line in rest] == ["not run |"] * 5 + ["– |"] + ["not run |"] * 2
    assert rest[5][:3] == ["| figure12, kitchen_2x2, state", "1 of 1", "5 of 5"]


def test_the_page_is_what_the_files_say():
    page = (ROOT / CLAIMS.page).read_text()
    assert CLAIMS.rewrite(page, make_table(read_experiments(ROOT / RESULTS))) == page


def test_nothing_found_is_one_line_and_what_says_nothing_has_its_reason(tmp_path):
    missing = {"where": "Section 6.1", "suite": "independent"} | NOT_RUN
    reason = {"holds": "not applicable", "not_applicable": "the base policy does 0.992 from the start"}
    for name, orders in (("a", [missing, missing]), ("b", [missing, ORDER | reason])):
        (tmp_path / name).mkdir()
        (tmp_path / name / "table1.json").write_text(json.dumps(FOUND | {"orders": orders}))
    lines = [line.split(" | ")[-4:] for line in make_table(read_experiments(tmp_path)).splitlines()[2:5]]
    assert lines[0] == ["2 sentences", "–", "–", "not run |"]
    assert lines[1][-1] == "not run |"
    assert lines[2][-1] == "not applicable: the base policy does 0.992 from the start |"


def test_one_experiment_comes_from_the_state_first_and_its_longest_runs(tmp_path):
    for name, obs_type, steps in (
        ("a", "pixels_agent_pos", 300),
        ("b", "pixels_agent_pos", 1_300),
        ("c", "environment_state_agent_pos", 300),
        ("d", "environment_state_agent_pos", 1_300),
    ):
        (tmp_path / name).mkdir()
        found = FOUND | {"obs_type": obs_type, "steps": steps, "orders": []}
        (tmp_path / name / "table1.json").write_text(json.dumps(found))
    lines = [line.split(" | ") for line in make_table(read_experiments(tmp_path)).splitlines()[2:6]]
    assert [(line[0].split(", ")[-1], line[3]) for line in lines] == [
        ("state", "1,300"), ("state", "300"), ("pixels", "1,300"), ("pixels", "300"),
    ]  # fmt: skip
