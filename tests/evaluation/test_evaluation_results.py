"""The numbers of results.json from hand-made outcomes, and which files are read."""

import json

import numpy as np
import pytest
from lerobot_env_cronos import EpisodeGroup, get_scene, load_orderings
from lerobot_env_cronos.benchmark.orderings import is_training_cycle

from cronos_lerobot.evaluation.eval_info import write_eval_info
from cronos_lerobot.evaluation.results import (
    FORMAT,
    find_results,
    find_videos,
    independent_results,
    read_evaluation,
    read_results,
    sequential_results,
    stream_results,
    success_rate,
)
from cronos_lerobot.scripts.eval import print_tables
from cronos_lerobot.statistics import wilson_interval

ORDERINGS = load_orderings("kitchen_2x2")
SCENE = get_scene("kitchen_2x2")
TASKS = SCENE.tasks
GROUPS = [EpisodeGroup(i, tasks, (0,), is_training_cycle(tasks, SCENE)) for i, tasks in enumerate(ORDERINGS)]


def outcomes(lengths_by_number, found=(), never_grasped=()):
    """Episodes of configurations 0, 1, ...; `found` and `never_grasped` are (number, configuration, position)."""

    def positions(which, *chain):
        return [position for *where, position in which if tuple(where) == chain]

    return [
        {"number": number, "configuration": c, "seed": 7, "length": length, "steps": 80}
        | {"found_complete": positions(found, number, c), "never_grasped": positions(never_grasped, number, c)}
        for number, lengths in lengths_by_number.items()
        for c, length in enumerate(lengths)
    ]


def test_sequential_results_of_a_hand_made_matrix():
    # Two orderings, four configurations. Tasks completed in a row: 4 2 0 1 and 1 1 0 0.
    results = sequential_results(outcomes({0: [4, 2, 0, 1], 5: [1, 1, 0, 0]}), GROUPS)
    assert results["n"] == 8
    # Position 0: 3 of 4 and 2 of 4. Position 1: 2 and 0. Positions 2 and 3: 1 and 0.
    assert [p["success"] for p in results["positions"]] == [5 / 8, 2 / 8, 1 / 8, 1 / 8]
    stds = [np.std(pair, ddof=1) for pair in ([0.75, 0.5], [0.5, 0.0], [0.25, 0.0], [0.25, 0.0])]
    assert [p["std"] for p in results["positions"]] == pytest.approx(stds)
    # Configurations 0 to 3 have 2, 2, 0, 1 successes at position 0, 0.75, 0.75, -1.25, -0.25 from the mean:
    # 4/3 * 2.75 / 64 = 0.0573 is the variance between them, 5/8 * 3/8 / 8 = 0.0293 that of eight trials. Their
    # ratio is 1.9556; Student's quantile with 3 degrees of freedom is 3.1824, the normal one 1.96.
    effective = 8 / 1.9556 * (1.96 / 3.1824) ** 2
    interval = wilson_interval(5 / 8 * effective, effective)
    assert results["positions"][0]["effective_n"] == pytest.approx(effective, rel=1e-3)
    assert results["positions"][0]["ci95"] == pytest.approx(interval, rel=1e-3)
    length = results["average_chain_length"]
    assert length["mean"] == 9 / 8 == sum(p["success"] for p in results["positions"])
    assert length["std"] == pytest.approx(np.std([7 / 4, 2 / 4], ddof=1))
    bounds = np.array([position["ci95"] for position in results["positions"]])
    assert length["ci95"] == pytest.approx(bounds.sum(axis=0).tolist())
    first, second = results["per_ordering"]
    assert second["tasks"] == [task.instruction for task in ORDERINGS[5]]
    assert first["positions"] == [0.75, 0.5, 0.25, 0.25]
    assert (first["average_chain_length"], second["average_chain_length"]) == (1.75, 0.5)


def test_the_tasks_of_a_configuration_are_correlated_in_the_independent_suite():
    """Two configurations where everything succeeds, two where nothing does: four trials, not sixteen."""
    results = independent_results(outcomes({i: [1, 1, 0, 0] for i in range(4)}), TASKS)
    assert (results["success"], results["n"]) == (0.5, 16)
    # Between configurations the variance is 4/3 * 4 * (4 - 2)^2 / 256 = 1/12, of 16 trials it is 1/64.
    effective = 16 / (64 / 12) * (1.959964 / 3.182446) ** 2
    assert results["effective_n"] == pytest.approx(effective, rel=1e-5)
    assert results["ci95"] == pytest.approx(wilson_interval(effective / 2, effective))
    assert results["ci95"][0] < wilson_interval(8, 16)[0] - 0.1
    # Of one task every configuration is there once.
    assert results["per_task"][TASKS[2].instruction]["ci95"] == list(wilson_interval(2, 4))


def test_orderings_of_the_training_cycle_are_reported_apart_from_the_others():
    a, b = [i for i, ordering in enumerate(ORDERINGS) if not is_training_cycle(ordering, SCENE)][:2]
    results = sequential_results(outcomes({0: [4, 4, 3, 1], a: [2, 0, 0, 0], b: [1, 1, 0, 0]}), GROUPS)
    seen, unseen = results["seen"], results["unseen"]
    assert (seen["n"], seen["orderings"], unseen["n"], unseen["orderings"]) == (4, 1, 8, 2)
    assert [p["success"] for p in seen["positions"]] == [1, 0.75, 0.75, 0.5]
    assert (seen["average_chain_length"]["mean"], unseen["average_chain_length"]["mean"]) == (3, 0.5)
    # One ordering has no spread; the cycle from its second task on is the same cycle.
    assert [p["std"] for p in seen["positions"]] == [None] * 4
    assert sequential_results(outcomes({0: [1]}), GROUPS[:1])["unseen"] is None


def test_successes_that_were_found_or_came_without_a_grasp_are_counted_at_their_position():
    some = outcomes(
        {0: [4, 2, 0], 1: [1, 1, 0]}, found=[(0, 0, 1), (0, 0, 3)], never_grasped=[(0, 1, 0), (1, 0, 0)]
    )
    counts = [[success_rate(some, k)[name] for k in range(4)] for name in ("found_complete", "never_grasped")]
    assert counts == [[0, 1, 0, 1], [2, 0, 0, 0]]
    for episode in some:
        del episode["never_grasped"]
    assert "never_grasped" not in success_rate(some)


FREE, OTHER, FALLEN, FOUND = "free", "on_other_receptacle", "fallen", "complete"


def streams():
    """Three streams of four segments: one is fine, one fell and is stuck, one stands still where it succeeded."""
    success = [[1, 1, 1, 1], [1, 0, 0, 0], [0, 0, 1, 1]]
    starts = [[FREE, OTHER, OTHER, OTHER], [FREE, FALLEN, FALLEN, FREE], [FREE, FREE, FOUND, FOUND]]
    return [
        {
            "number": 0,
            "configuration": c,
            "seed": 7,
            "length": sum(row),
            "steps": 320,
            "success": list(map(bool, row)),
        }
        | {"starts": starts[c], "found_complete": [2, 3] * (c == 2), "never_grasped": []}
        for c, row in enumerate(success)
    ]


def test_stream_results_by_hand():
    results = stream_results(streams(), cycle=2)
    assert (results["n"], results["segments"], results["success"]) == (3, 4, pytest.approx(7 / 12))
    assert [s["success"] for s in results["by_segment"]] == pytest.approx([2 / 3, 1 / 3, 2 / 3, 2 / 3])
    assert results["by_segment"][1]["ci95"] == pytest.approx(list(wilson_interval(1, 3)))
    assert [s["share_found_complete"] for s in results["by_segment"]] == pytest.approx([0, 0, 1 / 3, 1 / 3])
    assert results["share_found_complete"] == pytest.approx(2 / 12)
    assert (results["done"]["success"], results["done"]["n"]) == (0.5, 10)
    by_start = {name: (rate["success"], rate["n"]) for name, rate in results["by_start"].items()}
    assert by_start == {FREE: (0.4, 5), OTHER: (1, 3), FALLEN: (0, 2), FOUND: (1, 2)}
    assert results["by_start"][OTHER]["share"] == 0.25
    # The third stream's last two tasks were done already: the policy did neither.
    assert results["stuck"] == {"streams": 2, "share": 2 / 3, "causes": {FALLEN: 1, FOUND: 1}}


def header(suite, split="train", **changes):
    return {
        "format": FORMAT, "suite": suite, "split": split, "policy": "p", "policy_fingerprint": "f",
        "scene": "kitchen_2x2", "environment": "lerobot_env_cronos/kitchen_2x2-v1",
        "benchmark": {"fingerprint": "b"}, "seconds": 3.0, "advance": "window", "end_effector_reset": False,
    } | changes  # fmt: skip


def write(folder, suite, split, numbers, episodes, **changes):
    file = folder / f"{suite}_{split}/results.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(header(suite, split) | numbers | {"episodes": episodes} | changes))
    return file


def test_tables_are_printed_in_the_tasks_order(tmp_path, capsys):
    some = outcomes({0: [4, 2], 1: [1, 1]})
    for split in ("train", "held_out"):
        write(tmp_path, "sequential", split, sequential_results(some, GROUPS), some)
    single = outcomes({i: [1] for i in range(4)})
    write(tmp_path, "independent", "train", independent_results(single, TASKS), single)
    write(tmp_path, "stream", "train", stream_results(streams(), cycle=2), streams())
    print_tables(tmp_path)
    output = capsys.readouterr().out
    places = [output.index(text) for text in ("all tasks", *(task.instruction for task in TASKS))]
    assert places == sorted(places)
    for text in ("chain length", "0.5 ± 0.71 [", "segment 4"):
        assert text in output


def test_results_are_found_by_their_folders_and_videos_by_theirs(tmp_path):
    numbers, episodes = stream_results(streams(), 2), streams()
    train = write(tmp_path / "a/b", "stream", "train", numbers, episodes, videos=[{"path": "/etc/passwd"}])
    held_out = write(tmp_path / "a/b", "stream", "held_out", numbers, episodes)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/results.json").write_text("{}")
    assert find_results(tmp_path) == [train, held_out]
    assert [one["split"] for one in read_evaluation(tmp_path / "a")] == ["train", "held_out"]
    assert [one["split"] for one in read_evaluation(train)] == ["train"]
    with pytest.raises(FileNotFoundError, match="other"):
        read_evaluation(tmp_path / "other")
    (train.parent / "videos").mkdir()
    (train.parent / "videos/good.mp4").touch()
    (tmp_path / "secret.mp4").touch()
    (train.parent / "videos/link.mp4").symlink_to(tmp_path / "secret.mp4")
    assert find_videos(train) == [train.parent / "videos/good.mp4"]


@pytest.mark.parametrize(
    "content",
    [
        "[" * 100_000,
        '{"format"',
        "[]",
        json.dumps(header("chains")),
        json.dumps(header("stream", environment="lerobot_env_cronos/kitchen_2x2-v0")),
        json.dumps(header("stream", format=2)),
        json.dumps(header("stream", n=3, episodes="many")),
    ],
    ids=["nested", "cut off", "list", "suite", "version", "format", "types"],
)
def test_a_strangers_file_is_read_or_refused(content, tmp_path):
    file = tmp_path / "results.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=r"results\.json"):
        read_results(file)


def test_an_evaluation_in_lerobots_format(tmp_path):
    some = outcomes({0: [1, 0], 2: [1, 1]})
    write(tmp_path, "independent", "train", independent_results(some, TASKS[:1]), some)
    chains = outcomes({3: [4, 2]})
    video = write(tmp_path, "sequential", "held_out", sequential_results(chains, GROUPS), chains).parent
    (video / "videos").mkdir()
    (video / "videos/good.mp4").touch()
    write_eval_info(tmp_path)
    info = json.loads((tmp_path / "eval_info.json").read_text())
    first, second, third = info["per_task"]
    assert (first["task_group"], first["task_id"], second["task_id"]) == ("kitchen_2x2_independent_train", 0, 2)
    assert first["metrics"] == {
        "sum_rewards": [1, 0], "max_rewards": [1, 0], "successes": [True, False], "video_paths": [],
        "predicted_video_paths": [], "seeds": [0, 1], "sampling_seeds": [7, 7],
    }  # fmt: skip
    assert (first["n_success"], first["pc_success"]) == (1, 50)
    assert first["pc_success_ci95"] == pytest.approx([100 * bound for bound in wilson_interval(1, 2)])
    # A chain's rewards are its length, and it succeeds as a whole, as in lerobot-eval.
    assert third["metrics"]["sum_rewards"] == [4, 2]
    assert third["metrics"]["successes"] == [True, False]
    group = info["per_group"]["kitchen_2x2_sequential_held_out"]
    assert (group["avg_sum_reward"], group["n_episodes"]) == (3, 2)
    assert group["video_paths"] == [str(video / "videos/good.mp4")]
    overall = info["overall"]
    assert (overall["n_episodes"], overall["n_success"], overall["eval_s"]) == (6, 4, 6.0)
    assert {"avg_sum_reward", "avg_max_reward", "pc_success", "eval_ep_s", "predicted_video_paths"} <= set(overall)
