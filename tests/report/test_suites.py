"""Evaluations of cronos-eval in the report: which belong together, and what they are called."""

import base64
import json
import re

import pytest
from synthetic_runs import INSTRUCTIONS, read_csv

from cronos_lerobot.report.page import write_report
from cronos_lerobot.report.runs import find_runs
from cronos_lerobot.report.suite_views import sequential_figure
from cronos_lerobot.report.suites import policy_name
from cronos_lerobot.scripts.report import make_report


def write_results(folder, policy, content, **settings):
    folder.mkdir(parents=True)
    head = {"format": 2, "policy": policy, "temperature": 0.6, "scene": "kitchen_2x2"} | settings
    head["benchmark"] = {"environment": "lerobot_env_cronos/kitchen_2x2-v1"}
    (folder / "results.json").write_text(json.dumps(head | content))


APART = {"found_complete": 2, "never_grasped": 3}


def rate(success, n=64, std=0.1):
    return {"success": success, "n": n, "ci95": [max(0, success - 0.1), min(1, success + 0.1)], "std": std} | APART


def chains(successes):
    length = {"mean": sum(successes), "std": 0.2, "ci95": [0.5, 2.5]}
    return {"n": 640, "positions": [rate(s, 640) for s in successes], "average_chain_length": length}


def test_policies_of_one_short_name_are_each_told_by_what_differs(tmp_path):
    for seed in (1, 2, 3):
        content = {"independent": {"train": rate(0.5) | {"per_task": {}}}}
        write_results(tmp_path / str(seed), f"outputs/seed{seed}/eer/checkpoints/0102400", content)
    names = [run.name for run in find_runs([tmp_path]).suites]
    assert names == [f"eer 0102400 (policy=outputs/seed{seed}/eer/checkpoints/0102400)" for seed in (1, 2, 3)]


def test_two_policies_of_one_path_stay_apart(tmp_path):
    """The last checkpoint of a run that went on."""
    for name, fingerprint, success in (("a", "f1", 0.5), ("b", "f2", 0.75)):
        content = {"independent": {"train": rate(success) | {"per_task": {}}}}
        write_results(tmp_path / name, "run/checkpoints/last", content, policy_fingerprint=fingerprint)
    first, second = find_runs([tmp_path]).suites
    assert [run.splits("independent")["train"]["success"] for run in (first, second)] == [0.5, 0.75]
    assert "policy_fingerprint=f1" in first.name


def test_results_of_cronos_eval(tmp_path):
    """Both suites, in a folder each, of one policy; another temperature is another evaluation."""
    policy = "outputs/train/eer/checkpoints/0010240/pretrained_model"
    single = {"independent": {"train": rate(0.75) | {"per_task": {INSTRUCTIONS[0]: rate(0.5, 16)}}}}
    write_results(tmp_path / "e/single", policy, single)
    seen = {"seen": chains([1.0, 0.75]) | {"n": 64}, "unseen": None}
    sequential = {"sequential": {"train": chains([0.75, 0.5]) | seen, "held_out": chains([0.25, 0.0])}}
    video = {"path": "videos/a.mp4", "suite": "sequential", "split": "train", "kind": "good", "number": 3}
    sequential["videos"] = [video | {"configuration": 7, "length": 2}]
    write_results(tmp_path / "e/chains", policy, sequential)
    (tmp_path / "e/chains/videos").mkdir()
    (tmp_path / "e/chains/videos/a.mp4").write_bytes(b"a chain")
    (tmp_path / "e/results.json").write_text('{"something": "else"}')
    write_results(tmp_path / "greedy", policy, {"sequential": {"train": chains([1.0, 1.0])}}, temperature=0)
    page = write_report(
        make_report([tmp_path / "e/single", tmp_path / "e/chains"]), tmp_path / "report"
    ).read_text()
    rows = read_csv(tmp_path / "report/sequential.csv")
    columns = ("policy", "split", "orderings", "SEQ 0", "SEQ 1", "chain length", "chains", "never_grasped")
    assert [tuple(r[name] for name in columns) for r in rows] == [
        ("eer 0010240", "train", "all", "0.75", "0.5", "1.25", "640", "6"),
        ("eer 0010240", "train", "seen", "1.0", "0.75", "1.75", "64", "6"),
        ("eer 0010240", "held_out", "all", "0.25", "0.0", "0.25", "640", "6"),
    ]
    rows = read_csv(tmp_path / "report/independent.csv")
    assert [(r["task"], r["success"], r["n"], r["found_complete"]) for r in rows] == [
        ("all tasks", "0.75", "64", "2"),
        (INSTRUCTIONS[0], "0.5", "16", "2"),
    ]
    assert "1.25 ± 0.2 [0.5, 2.5]" in page
    assert base64.b64encode(b"a chain").decode() in page
    assert "eer 0010240, ordering 3, configuration 7: 2 done" in page
    content = base64.b64encode((tmp_path / "report/sequential.png").read_bytes()).decode()
    assert content in page
    runs = find_runs([tmp_path / "e/chains", tmp_path / "greedy"]).suites
    assert [run.name for run in runs] == ["eer 0010240 (temperature=0.6)", "eer 0010240 (temperature=0)"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other/results.json").write_text("[]")
    with pytest.raises(FileNotFoundError, match="cronos-eval"):
        find_runs([tmp_path / "other"])


def test_a_quick_evaluation_does_not_replace_the_whole_one(tmp_path):
    for name, successes, n in (("whole", [0.75, 0.5], 64), ("whole_quick", [0.25, 0.0], 16)):
        identity = {"identity": {"policy": "1a2b", "n_episodes": n, "orderings": 10}}
        write_results(tmp_path / name, "me/policy", {"sequential": {"train": chains(successes)}}, **identity)
    runs = find_runs([tmp_path]).suites
    assert [(run.name, run.results["sequential"]["train"]["positions"][0]["success"]) for run in runs] == [
        ("me/policy (n_episodes=64)", 0.75), ("me/policy (n_episodes=16)", 0.25),
    ]  # fmt: skip


def test_pictures_of_another_renderer_are_another_evaluation(tmp_path):
    identity = {"policy": "1a2b", "n_episodes": 64, "orderings": 10}
    for name, successes, own in (("a", [0.75, 0.5], {}), ("b", [0.25, 0.0], {"renderer": "filament"})):
        content = {"sequential": {"train": chains(successes)}}
        write_results(tmp_path / name, "me/policy", content, identity=identity | own)
    assert [run.name for run in find_runs([tmp_path]).suites] == [
        "me/policy (renderer=classic)", "me/policy (renderer=filament)",
    ]  # fmt: skip


def test_pictures_of_another_camera_are_another_evaluation(tmp_path):
    names = {"observation.images.bridge": "observation.images.front"}
    for name, successes, camera, renamed in (("a", [0.9], "front", {}), ("b", [0.1], "bridge", names)):
        identity = {"env": {"camera_name": camera, "observation_width": 224}, "rename_map": renamed}
        own = {"identity": identity, "obs_type": "pixels_agent_pos"}
        write_results(tmp_path / name, "me/policy", {"sequential": {"train": chains(successes)}}, **own)
    front, bridge = find_runs([tmp_path]).suites
    assert front.name == "me/policy (camera_name=front, rename_map=None)"
    assert bridge.name == f"me/policy (camera_name=bridge, rename_map={names})"
    assert [run.results["sequential"]["train"]["positions"][0]["success"] for run in (front, bridge)] == [0.9, 0.1]


def test_bars_of_chains_have_the_legends_colours_and_there_are_as_many_as_policies(tmp_path):
    write_results(tmp_path / "0", "me/0", {"sequential": {"train": chains([0.9, 0])}})
    for i in range(1, 9):
        write_results(tmp_path / str(i), f"me/{i}", {"sequential": {"held_out": chains([i / 10, 0])}})
    figure = sequential_figure(find_runs([tmp_path]).suites)
    train, held_out = figure.axes
    told = {text.get_text(): patch for text, patch in zip(*legend_of(figure), strict=True)}
    assert list(told) == [f"me/{i}" for i in range(9)]
    # The bars of the first task.
    bars = [*train.patches, *held_out.patches][::2]
    assert [bar.get_height() for bar in bars] == [0.9, *(i / 10 for i in range(1, 9))]
    looks = [(patch.get_facecolor(), patch.get_hatch()) for patch in told.values()]
    assert [(bar.get_facecolor(), bar.get_hatch()) for bar in bars] == looks
    assert len(set(looks)) == 9


def legend_of(figure):
    (legend,) = figure.legends
    return legend.get_texts(), legend.get_patches()


def test_columns_of_scenes_with_more_tasks_stay_in_their_place(tmp_path):
    write_results(tmp_path / "a", "me/two", {"sequential": {"train": chains([0.75, 0.5])}})
    write_results(
        tmp_path / "b", "me/three", {"sequential": {"train": chains([0.7, 0.6, 0.4])}}, scene="kitchen_3x3"
    )
    page = write_report(make_report([tmp_path]), tmp_path / "report").read_text()
    table = page[page.index("<th>SEQ 0</th>") :]
    table = table[: table.index("</table>")]
    names = re.findall(r"<th>(.*?)</th>", page[: page.index(table) + len(table)].split("<table>")[-1])
    rows = [re.findall(r"<td>(.*?)</td>", line) for line in table.splitlines() if "<td>" in line]
    two, three = (dict(zip(names, row, strict=True)) for row in rows)
    assert (two["chain length"].split()[0], two["SEQ 2"]) == ("1.25", "")
    assert (three["chain length"].split()[0], three["SEQ 2"].split()[0]) == ("1.7", "0.4")


def test_policies_in_short():
    assert (
        policy_name("out/runs/t80_1300k/seed1/train/checkpoints/0102400/pretrained_model")
        == "t80_1300k/seed1 0102400"
    )
    assert policy_name("outputs/train/eer/checkpoints/last/pretrained_model") == "eer last"
    assert policy_name("someone/policy") == "someone/policy"
