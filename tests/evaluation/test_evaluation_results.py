"""The numbers of results.json from hand-made outcomes."""

import json

import numpy as np
import pytest
from lerobot_env_cronos import get_scene, load_orderings
from lerobot_env_cronos.statistics import wilson_interval

from cronos_lerobot.evaluation.chains import Chain, ChainResult, Trajectory
from cronos_lerobot.evaluation.film import choose
from cronos_lerobot.evaluation.rates import SuccessRate
from cronos_lerobot.evaluation.results import independent_results, make_tables, sequential_results
from cronos_lerobot.evaluation.store import ResultStore, chain_records

ORDERINGS = load_orderings("kitchen_2x2")
TASKS = get_scene("kitchen_2x2").tasks


def records(lengths_by_number, found=(), never_grasped=()):
    """Outcomes of configurations 0, 1, ...; `found` and `never_grasped` are (number, configuration, position)."""

    def positions(which, *chain):
        return [position for *where, position in which if tuple(where) == chain]

    return [
        {
            "number": number,
            "configuration": c,
            "length": length,
            "steps": 80,
            "found_complete": positions(found, number, c),
            "never_grasped": positions(never_grasped, number, c),
        }
        for number, lengths in lengths_by_number.items()
        for c, length in enumerate(lengths)
    ]


def test_sequential_results_of_a_hand_made_matrix():
    # Two orderings, four configurations. Tasks completed in a row: 4 2 0 1 and 1 1 0 0.
    results = sequential_results(records({0: [4, 2, 0, 1], 5: [1, 1, 0, 0]}), ORDERINGS)
    assert results["n"] == 8
    # Position 0: 3 of 4 and 2 of 4. Position 1: 2 and 0. Positions 2 and 3: 1 and 0.
    assert [p["success"] for p in results["positions"]] == [5 / 8, 2 / 8, 1 / 8, 1 / 8]
    assert all(p["n"] == 8 for p in results["positions"])
    stds = [np.std(pair, ddof=1) for pair in ([0.75, 0.5], [0.5, 0.0], [0.25, 0.0], [0.25, 0.0])]
    assert [p["std"] for p in results["positions"]] == pytest.approx(stds)
    assert results["positions"][0]["ci95"] == list(wilson_interval(5, 8))
    length = results["average_chain_length"]
    assert length["mean"] == 9 / 8 == sum(p["success"] for p in results["positions"])
    assert length["std"] == pytest.approx(np.std([7 / 4, 2 / 4], ddof=1))
    bounds = [wilson_interval(k, 8) for k in (5, 2, 1, 1)]
    assert length["ci95"] == pytest.approx([sum(low for low, _ in bounds), sum(high for _, high in bounds)])
    first, second = results["per_ordering"]
    assert (first["ordering"], second["ordering"]) == (0, 5)
    assert second["tasks"] == [task.instruction for task in ORDERINGS[5]]
    assert first["positions"] == [0.75, 0.5, 0.25, 0.25]
    assert (first["average_chain_length"], second["average_chain_length"]) == (1.75, 0.5)


def test_a_single_ordering_has_no_spread_over_orderings():
    results = sequential_results(records({0: [4, 0]}), ORDERINGS)
    assert [p["std"] for p in results["positions"]] == [None] * 4
    assert results["average_chain_length"]["std"] is None


def test_independent_results_by_hand():
    results = independent_results(records({0: [1, 1], 1: [1, 0], 2: [0, 0], 3: [0, 1]}), TASKS)
    assert (results["success"], results["n"]) == (0.5, 8)
    assert [r["success"] for r in results["per_task"].values()] == [1.0, 0.5, 0.0, 0.5]
    assert list(results["per_task"]) == [task.instruction for task in TASKS]
    assert results["per_task"][TASKS[2].instruction]["ci95"] == list(wilson_interval(0, 2))


def test_successes_that_were_found_or_came_without_a_grasp_are_counted_apart_at_their_position():
    some = records(
        {0: [4, 2, 0], 1: [1, 1, 0]}, found=[(0, 0, 1), (0, 0, 3)], never_grasped=[(0, 1, 0), (1, 0, 0)]
    )
    assert SuccessRate.of(some) == SuccessRate(4, 6, found_complete=0, never_grasped=2)
    assert SuccessRate.of(some, 1) == SuccessRate(2, 6, found_complete=1, never_grasped=0)
    positions = sequential_results(some, ORDERINGS)["positions"]
    assert [p["found_complete"] for p in positions] == [0, 1, 0, 1]
    assert [p["never_grasped"] for p in positions] == [2, 0, 0, 0]
    tasks = independent_results(records({i: [1, 0] for i in range(4)}, never_grasped=[(2, 0, 0)]), TASKS)
    assert tasks["never_grasped"] == tasks["per_task"][TASKS[2].instruction]["never_grasped"] == 1
    assert sum(rate["never_grasped"] for rate in tasks["per_task"].values()) == 1


def test_tables_have_a_row_for_each_position_and_a_column_for_each_split():
    split = sequential_results(records({0: [4, 2], 1: [1, 1]}), ORDERINGS)
    results = {
        "advance": "window",
        "end_effector_reset": False,
        "sequential": {"train": split, "held_out": split},
        "independent": {"train": independent_results(records({i: [1] for i in range(4)}), TASKS)},
    }
    independent, sequential = make_tables(results)
    assert (independent.row_count, len(independent.columns)) == (5, 2)
    assert (sequential.row_count, len(sequential.columns)) == (5, 3)
    assert "end_effector_reset=false" in str(sequential.title)
    cells = list(sequential.columns[1].cells)
    assert cells[0].startswith("1.000 ± 0.000 [")
    assert cells[1].startswith("0.500 ± 0.707 [")
    assert cells[-1].startswith("2.000 ± 1.414 [")


def test_the_longest_and_the_shortest_chains_are_filmed():
    some = records({0: [4, 2, 0], 1: [4, 1, 0]})
    chosen = choose(some, 4, 2)
    names = {kind: [(r["number"], r["configuration"]) for r in rows] for kind, rows in chosen.items()}
    assert names == {"good": [(0, 0), (1, 0)], "bad": [(0, 2), (1, 2)]}
    # Nothing good to show, nothing bad to show, and never the same chain twice.
    assert choose(records({0: [0, 0]}), 4, 1)["good"] == []
    assert choose(records({0: [4, 4]}), 4, 1)["bad"] == []
    assert [len(rows) for rows in choose(records({0: [2]}), 4, 1).values()] == [1, 0]


def test_a_store_keeps_parts_and_refuses_another_evaluation(tmp_path):
    folder = tmp_path / "out"
    store = ResultStore(folder, {"seed": 1, "pair": (1, 2)})
    trajectory = Trajectory(np.ones((3, 5), np.float32), np.array([0, 0, 1]), np.array([False, True, False]))
    result = ChainResult(Chain(2, TASKS, 7), 1, 160, trajectory, never_grasped=(0,))
    content = {"chains": chain_records([result])}
    assert store.read("a") is None
    store.write("a", content, {"2_7": trajectory})
    again = ResultStore(folder, {"seed": 1, "pair": [1, 2]})
    assert again.read("a") == content
    record = {
        "number": 2,
        "configuration": 7,
        "length": 1,
        "steps": 160,
        "found_complete": [],
        "never_grasped": [0],
    }
    assert content["chains"] == [record]
    read = again.read_trajectory("a", "2_7")
    for name in ("qpos", "position", "is_complete"):
        np.testing.assert_array_equal(getattr(read, name), getattr(trajectory, name))
    assert again.read_trajectory("a", "2_8") is None
    with pytest.raises(ValueError, match=r"seed: 1 there, 2 now.*--output_dir"):
        ResultStore(folder, {"seed": 2, "pair": (1, 2)})
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("")
    with pytest.raises(FileExistsError, match="other"):
        ResultStore(other, {})
    assert json.loads((folder / "evaluation.json").read_text())["seed"] == 1
