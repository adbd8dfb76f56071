"""The numbers of results.json from hand-made outcomes."""

import json

import numpy as np
import pytest
from lerobot_env_cronos import get_scene, load_orderings
from lerobot_env_cronos.benchmark.orderings import is_training_cycle
from lerobot_env_cronos.statistics import wilson_interval

from cronos_lerobot.evaluation.chains import Chain, ChainResult, Trajectory
from cronos_lerobot.evaluation.film import choose
from cronos_lerobot.evaluation.rates import SuccessRate, cluster_interval, effective_trials
from cronos_lerobot.evaluation.results import independent_results, make_tables, sequential_results
from cronos_lerobot.evaluation.store import ResultStore, chain_records, read_results

IDENTITY = {"environment": "lerobot_env_cronos/kitchen_2x2-v1"}
ORDERINGS = load_orderings("kitchen_2x2")
SCENE = get_scene("kitchen_2x2")
TASKS = SCENE.tasks


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
    results = sequential_results(records({0: [4, 2, 0, 1], 5: [1, 1, 0, 0]}), ORDERINGS, SCENE)
    assert results["n"] == 8
    # Position 0: 3 of 4 and 2 of 4. Position 1: 2 and 0. Positions 2 and 3: 1 and 0.
    assert [p["success"] for p in results["positions"]] == [5 / 8, 2 / 8, 1 / 8, 1 / 8]
    assert all(p["n"] == 8 for p in results["positions"])
    stds = [np.std(pair, ddof=1) for pair in ([0.75, 0.5], [0.5, 0.0], [0.25, 0.0], [0.25, 0.0])]
    assert [p["std"] for p in results["positions"]] == pytest.approx(stds)
    # Configurations 0 to 3 have 2, 2, 0, 1 successes at position 0, 0.75, 0.75, -1.25, -0.25 from the mean:
    # 4/3 * 2.75 / 64 = 0.0573 is the variance between them, 5/8 * 3/8 / 8 = 0.0293 that of eight trials. Their
    # ratio is 1.9556; Student's quantile with 3 degrees of freedom is 3.1824, the normal one 1.96.
    effective = 8 / 1.9556 * (1.96 / 3.1824) ** 2
    assert results["positions"][0]["effective_n"] == pytest.approx(effective, rel=1e-3)
    assert results["positions"][0]["ci95"] == pytest.approx(
        wilson_interval(5 / 8 * effective, effective), rel=1e-3
    )
    length = results["average_chain_length"]
    assert length["mean"] == 9 / 8 == sum(p["success"] for p in results["positions"])
    assert length["std"] == pytest.approx(np.std([7 / 4, 2 / 4], ddof=1))
    bounds = np.array([position["ci95"] for position in results["positions"]])
    assert length["ci95"] == pytest.approx(bounds.sum(axis=0).tolist())
    first, second = results["per_ordering"]
    assert (first["ordering"], second["ordering"]) == (0, 5)
    assert second["tasks"] == [task.instruction for task in ORDERINGS[5]]
    assert first["positions"] == [0.75, 0.5, 0.25, 0.25]
    assert (first["average_chain_length"], second["average_chain_length"]) == (1.75, 0.5)


def test_trials_that_all_came_out_alike_say_as_much_as_one_for_each_configuration():
    results = sequential_results(records({0: [4, 4, 4], 1: [4, 4, 4]}), ORDERINGS, SCENE)
    assert results["positions"][3]["ci95"] == list(wilson_interval(3, 3))
    # One ordering: every configuration once, and nothing to go together.
    results = sequential_results(records({0: [4, 0, 2]}), ORDERINGS, SCENE)
    assert results["positions"][0]["ci95"] == list(wilson_interval(2, 3))
    # A single configuration is one trial.
    assert effective_trials(np.array([True, False, True]), np.zeros(3)) == 1


@pytest.mark.parametrize(("num_clusters", "size"), [(64, 10), (16, 3)])
def test_the_interval_by_cluster_covers_what_it_says_and_the_one_over_all_trials_does_not(num_clusters, size):
    rng = np.random.default_rng(0)
    clusters = np.repeat(np.arange(num_clusters), size)
    covered = np.zeros(2)
    for _ in range(500):
        # Half of the configurations are easy, half hard: within one, outcomes go together.
        rates = np.where(rng.random(num_clusters) < 0.5, 0.95, 0.05)
        successes = rng.random(num_clusters * size) < np.repeat(rates, size)
        intervals = cluster_interval(successes, clusters), wilson_interval(successes.sum(), len(successes))
        covered += [low <= 0.5 <= high for low, high in intervals]
    by_cluster, over_all = covered / 500
    assert 0.93 <= by_cluster <= 0.99
    assert over_all < 0.8


def test_orderings_of_the_training_cycle_are_reported_apart_from_the_others():
    a, b = [i for i, ordering in enumerate(ORDERINGS) if not is_training_cycle(ordering, SCENE)][:2]
    results = sequential_results(records({0: [4, 4, 3, 1], a: [2, 0, 0, 0], b: [1, 1, 0, 0]}), ORDERINGS, SCENE)
    seen, unseen = results["seen"], results["unseen"]
    assert (seen["n"], seen["orderings"], unseen["n"], unseen["orderings"]) == (4, 1, 8, 2)
    assert [p["success"] for p in seen["positions"]] == [1, 0.75, 0.75, 0.5]
    assert [p["success"] for p in unseen["positions"]] == [3 / 8, 1 / 8, 0, 0]
    assert (seen["average_chain_length"]["mean"], unseen["average_chain_length"]["mean"]) == (3, 0.5)
    assert [row["seen"] for row in results["per_ordering"]] == [True, False, False]
    # The cycle from its second task on is the same cycle.
    rotated = [*TASKS[1:], TASKS[0]]
    assert sequential_results(records({0: [1]}), [rotated], SCENE)["unseen"] is None


def test_a_single_ordering_has_no_spread_over_orderings():
    results = sequential_results(records({0: [4, 0]}), ORDERINGS, SCENE)
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
    positions = sequential_results(some, ORDERINGS, SCENE)["positions"]
    assert [p["found_complete"] for p in positions] == [0, 1, 0, 1]
    assert [p["never_grasped"] for p in positions] == [2, 0, 0, 0]
    tasks = independent_results(records({i: [1, 0] for i in range(4)}, never_grasped=[(2, 0, 0)]), TASKS)
    assert tasks["never_grasped"] == tasks["per_task"][TASKS[2].instruction]["never_grasped"] == 1
    assert sum(rate["never_grasped"] for rate in tasks["per_task"].values()) == 1


def test_tables_have_a_row_for_each_position_and_a_column_for_each_split():
    some = records({0: [4, 2], 1: [1, 1]}, found=[(0, 0, 1), (0, 1, 1)], never_grasped=[(0, 0, 3)])
    split = sequential_results(some, ORDERINGS, SCENE)
    results = {
        "advance": "window",
        "end_effector_reset": False,
        "sequential": {"train": split, "held_out": split},
        "independent": {"train": independent_results(records({i: [1] for i in range(4)}), TASKS)},
    }
    independent, sequential = make_tables(results)
    # Tasks, all of them, found complete, never grasped; all, seen and unseen orderings of 1 + 5 rows each.
    assert (independent.row_count, len(independent.columns)) == (4 + 1 + 2, 2)
    assert (sequential.row_count, len(sequential.columns)) == (3 * 6 + 2, 3)
    assert "end_effector_reset=false" in str(sequential.title)
    cells = list(sequential.columns[1].cells)
    assert cells[0] == "n=4"
    assert cells[1].startswith("1.000 ± 0.000 [")
    assert cells[2].startswith("0.500 ± 0.707 [")
    assert cells[5].startswith("2.000 ± 1.414 [")
    assert (cells[6], cells[7][:7], cells[12]) == ("n=2", "1.000 [", "n=2")
    assert cells[-2:] == ["2", "1"]


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
    store = ResultStore(folder, IDENTITY | {"seed": 1, "pair": (1, 2)})
    trajectory = Trajectory(np.ones((3, 5), np.float32), np.array([0, 0, 1]), np.array([False, True, False]))
    result = ChainResult(Chain(2, TASKS, 7), 1, 160, trajectory, never_grasped=(0,))
    content = {"chains": chain_records([result])}
    assert store.read("a") is None
    store.write("a", content, {"2_7": trajectory})
    again = ResultStore(folder, IDENTITY | {"seed": 1, "pair": [1, 2]})
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
        ResultStore(folder, IDENTITY | {"seed": 2, "pair": (1, 2)})
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("")
    with pytest.raises(FileExistsError, match="other"):
        ResultStore(other, {})
    assert json.loads((folder / "evaluation.json").read_text())["seed"] == 1


def test_what_version_0_left_is_refused_with_a_sentence(tmp_path):
    # As version 0 wrote them.
    folder = tmp_path / "old"
    folder.mkdir()
    (folder / "evaluation.json").write_text(json.dumps({"policy": "ab", "versions": {"configurations": 0}}))
    with pytest.raises(ValueError, match=r"evaluation in .*old .*version 1.*another --output_dir"):
        ResultStore(folder, IDENTITY)
    results = {"format": 1, "benchmark": {"environment": "lerobot_env_cronos/kitchen_2x2-v0"}}
    (folder / "results.json").write_text(json.dumps(results))
    with pytest.raises(ValueError, match=r"results.json was made with .*-v0; this is version 1.*evaluate anew"):
        read_results(folder)
    (folder / "results.json").write_text('{"format"')
    with pytest.raises(ValueError, match=r"results.json is damaged"):
        read_results(folder)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_results(tmp_path / "nowhere")
