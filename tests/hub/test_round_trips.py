"""Everything that is published, pushed to a Hub over HTTP by the public commands, and loaded back elsewhere."""

import json
import re

import pytest
import yaml
from hub_repositories import File

BENCHMARK = ("benchmark", "--repo_id=me/bench", "--scene=playroom_2x2", "--seed=5", "--num_configurations=2",
             "--num_orderings=2", "--chain_length=2")  # fmt: skip
TRAINING = (
    "--policy.type=pocketvla", "--policy.device=cpu", "--policy.hidden_width=16", "--policy.hidden_depth=1",
    "--policy.push_to_hub=false", "--env.type=cronos", "--num_envs=2", "--protocol.task_switch_interval=4",
    "--protocol.update_interval=8", "--protocol.scene_reset_interval=8", "--steps=32", "--save_freq=16",
    "--eval_freq=0", "--tensorboard=false", "--algorithm.minibatch_size=8", "--algorithm.value_warmup_updates=0",
    "--record.repo_id=me/stream", "--record.streams=1", "--env.observation_height=32",
    "--env.observation_width=32", "--protocol.num_configurations=2", "--protocol.end_effector_reset=true",
)  # fmt: skip


def tree(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def bench(served, commands, tmp_path_factory):
    """A benchmark on the Hub, and its dry run."""
    folder = tmp_path_factory.mktemp("dry") / "bench"
    commands.run("cronos-publish", *BENCHMARK, "--dry_run=true", f"--output_dir={folder}")
    assert ("datasets", "me/bench") not in served.repositories, "a dry run pushes nothing"
    output = commands.run("cronos-publish", *BENCHMARK)
    assert f"{served.url}/datasets/me/bench" in output
    return folder


@pytest.fixture(scope="module")
def run(bench, commands, tmp_path_factory):
    """A training run on the Hub's benchmark, too short to learn, with a recorded stream."""
    folder = tmp_path_factory.mktemp("train") / "run"
    commands.run("cronos-train", *TRAINING, "--env.benchmark=me/bench", f"--output_dir={folder}")
    return folder


@pytest.fixture(scope="module")
def policy(run, commands):
    """The policy on the Hub."""
    commands.run("cronos-publish", "policy", f"--path={run}", "--repo_id=me/policy")
    return "me/policy"


def test_a_benchmark_is_what_the_dry_run_showed_and_loads_with_datasets(hub, bench, commands):
    assert hub.tree("datasets", "me/bench") == tree(bench)
    commands.forget()
    code = """
from datasets import load_dataset
chains = load_dataset("me/bench", "sequential", split="held_out")
print([(row["ordering"], row["configuration"], len(row["instructions"])) for row in chains])
rows = load_dataset("me/bench", "configurations", split="train")
print(rows[1]["picture"].size, rows[1]["toy_bear_x_m"])
print(load_dataset("me/bench", "independent", split="train").num_rows, load_dataset("me/bench").keys())
"""
    output = commands.run("python", code)
    assert "[(0, 0, 2), (0, 1, 2), (1, 0, 2), (1, 1, 2)]" in output
    assert re.search(r"\(320, 240\) 0\.[23]\d+", output)
    assert "8 dict_keys(['train', 'held_out'])" in output
    tasks = yaml.safe_load((bench / "eval.yaml").read_text())["tasks"]
    assert {"id": "sequential_held_out", "config": "sequential", "split": "held_out"} in tasks


def test_lerobot_eval_runs_the_benchmark_from_the_hub(bench, policy, commands, tmp_path):
    """By its name, and by the repository's own code where that is allowed to run."""
    flags = (
        f"--policy.path={policy}", "--policy.device=cpu", "--env.suite=sequential", "--env.split=held_out",
        "--env.task=1", "--env.observation_height=32", "--env.observation_width=32", "--eval.n_episodes=2",
        "--eval.batch_size=2", "--env.render_size=[32, 32]",
    )  # fmt: skip
    own_code = ("--env.type=cronos_hub", "--env.hub_path=me/bench")
    refused = commands.try_("lerobot-eval", *flags, *own_code, f"--output_dir={tmp_path / 'refused'}")
    assert (refused.code, "Refusing to execute remote code" in refused.output) == (1, True)
    commands.forget()
    for name, env in (
        ("data", ("--env.type=cronos", "--env.benchmark=me/bench@main")),
        ("code", (*own_code, "--trust_remote_code=true")),
    ):
        commands.run("lerobot-eval", *flags, *env, f"--output_dir={tmp_path / name}")
        info = json.loads((tmp_path / name / "eval_info.json").read_text())
        assert [(task["task_group"], task["task_id"]) for task in info["per_task"]] == [("sequential_held_out", 1)]
        assert info["overall"]["n_episodes"] == 2


def test_a_stream_is_loaded_back_whole(hub, run, commands, tmp_path):
    publish = ("cronos-publish", "stream", f"--root={run / 'streams'}", "--repo_id=me/stream", "--private=true")
    commands.run(*publish, "--dry_run=true", f"--output_dir={tmp_path / 'dry'}")
    commands.run(*publish)
    assert hub.tree("datasets", "me/stream") == tree(tmp_path / "dry")
    repository = hub.repositories["datasets", "me/stream"]
    assert repository.private
    assert repository.tags["v3.0"] == repository.branches["main"]
    commands.forget()
    code = """
from cronos_lerobot.data.streams import StreamDataset
import os; from lerobot.datasets import LeRobotDataset
(remote := StreamDataset("me/stream", streaming=True)).check()
# What LeRobot's cache has a part of is read from the Hub all the same.
LeRobotDataset("me/stream", episodes=[0], download_videos=False)
in_part = StreamDataset("me/stream", streaming=True)
assert (in_part.meta.root / "data").is_dir() and not in_part.is_local
for one in (in_part, StreamDataset("me/stream", os.environ["HF_HOME"] + "/new", streaming=True)): one.check()
in_part.pixels(in_part.segments_of(0)[2], "observation.images.front")
streams = StreamDataset("me/stream")
streams.check()
camera, segment = "observation.images.front", streams.segments_of(0)[2]
assert remote.segments == streams.segments
assert (remote.pixels(segment, camera) == streams.pixels(segment, camera)).all()
assert (remote.columns(segment)["action"] == streams.columns(segment)["action"]).all()
print([(s.step, s.length, s.event.name) for s in streams.segments_of(0)])
print(streams.dataset[15]["observation.images.front"].shape)
"""
    output = commands.run("python", code)
    assert "(0, 4, 'INITIAL'), (4, 4, 'END_EFFECTOR_RESET'), (8, 4, 'SCENE_RESET'), (12, 4," in output
    assert "torch.Size([3, 32, 32])" in output
    # A branch is for those who name it: the tag, which LeRobot reads at, stays.
    commands.run(*publish, "--branch=trial/1")
    assert set(repository.branches) == {"main", "trial/1"}
    assert repository.tags == {"v3.0": repository.branches["main"]}
    branch = commands.run("cronos-streams", "check", "--dataset.repo_id=me/stream", "--dataset.revision=trial/1")
    assert "whole: 1 streams, 4 segments, 16 frames" in branch


def test_a_policy_is_loaded_back_as_its_card_says(hub, run, policy, commands, tmp_path):
    commands.run("cronos-publish", "policy", f"--path={run}", "--repo_id=me/policy", "--dry_run=true",
                 f"--output_dir={tmp_path / 'dry'}")  # fmt: skip
    assert hub.tree("models", policy) == tree(tmp_path / "dry")
    model = tree(run / "checkpoints/last/pretrained_model")
    assert hub.tree("models", policy).keys() == model.keys() | {"README.md", "cronos_training.json"}
    for name in model.keys() - {"train_config.json"}:
        assert hub.tree("models", policy)[name] == model[name]
    card = (tmp_path / "dry/README.md").read_text()
    front = yaml.safe_load(card.split("---")[1])
    assert front["datasets"] == ["me/stream"]
    assert "base_model" not in front
    commit = hub.repositories["datasets", "me/bench"].branches["main"]
    assert f"| `--env.benchmark` | `me/bench@{commit}` |" in card
    # 32 steps are 16 of each of the 2 streams; the scene of each is reset after 8 and after 16.
    assert "- Interventions: 4\n" in card
    assert "| `scene reset` | 4 | yes |" in card
    commands.forget()
    (code,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    assert "PocketVLA" in commands.run("python", f"{code}\nprint(type(policy).__name__)")
    first = commands.run("cronos-publish", "policy", f"--path={run / 'checkpoints/000016'}", "--repo_id=me/first",
                         "--dry_run=true", f"--output_dir={tmp_path / 'first'}")  # fmt: skip
    assert "after 16 interaction steps" in first
    assert "- Interventions: 2\n" in (tmp_path / "first/README.md").read_text()


@pytest.fixture(scope="module")
def evaluation(policy, commands, tmp_path_factory):
    """Results of the Hub's policy on the Hub's benchmark."""
    folder = tmp_path_factory.mktemp("evaluation") / "eval"
    commands.run("cronos-eval", f"--policy.path={policy}", "--env.benchmark=me/bench", "--eval.videos=0",
                 "--eval.suites=[independent]", f"--output_dir={folder}")  # fmt: skip
    return folder


def test_results_join_those_of_others(hub, policy, evaluation, commands, tmp_path):
    other = {"dataset": {"id": "other/bench", "task_id": "t"}, "value": 3, "source": {"url": "https://x"}}
    old = {"dataset": {"id": "me/bench", "task_id": "independent_train"}, "value": -1}
    publish = ("cronos-publish", "results", f"--results={evaluation}", f"--repo_id={policy}")
    there = File(yaml.safe_dump([old, other]).encode(), is_lfs=False)
    hub.repositories["models", policy].commit("main", "results", {".eval_results/cronos.yaml": there}, [])
    before, hub.faults.drop_downloads_of = hub.tree("models", policy), "cronos.yaml"
    # It may have results: they are not taken for none.
    assert "lost the connection" in commands.try_(*publish, impatient=True).output
    hub.faults.drop_downloads_of = None
    assert hub.tree("models", policy) == before
    commands.run(*publish, "--dry_run=true", f"--output_dir={tmp_path / 'dry'}")
    commands.run(*publish)
    after = hub.tree("models", policy)
    assert after == before | tree(tmp_path / "dry")
    entries = yaml.safe_load(after[".eval_results/cronos.yaml"])
    assert [entry["dataset"]["task_id"] for entry in entries] == ["independent_train", "t", "independent_held_out"]
    assert entries[1] == other
    for i, split in ((0, "train"), (2, "held_out")):
        written = json.loads((evaluation / f"independent_{split}/results.json").read_text())
        assert re.fullmatch(r"[0-9a-f]{40}", written["policy_revision"])
        assert entries[i]["value"] == pytest.approx(100 * written["success"])
        assert entries[i]["dataset"]["revision"] == hub.repositories["datasets", "me/bench"].branches["main"]
        assert "n=8" in entries[i]["notes"]
        assert "; trained for 32 steps, 4 interventions, seed 1000, from scratch; " in entries[i]["notes"]


def test_a_training_begins_with_one_commit_of_a_policy(hub, run, commands, tmp_path):
    """All of it is of the revision that is given, or of what `main` is when the run begins."""
    policy = "me/trained_on"
    commands.run("cronos-publish", "policy", f"--path={run}", f"--repo_id={policy}")
    repository = hub.repositories["models", policy]
    first = repository.branches["main"]
    old = hub.tree("models", policy)
    config = json.loads(old["config.json"]) | {"sigma_init": 0.3}
    processor = old["policy_preprocessor.json"].replace(b'"name": "', b'"name": "new_')
    assert processor != old["policy_preprocessor.json"]
    changed = {"config.json": json.dumps(config).encode(), "policy_preprocessor.json": processor}
    repository.commit("main", "trained on", {name: File(text, False) for name, text in changed.items()}, [])
    flags = [flag for flag in TRAINING if not flag.startswith(("--policy.", "--record."))]
    for name, revision, sigma in ((f"{policy}@{first}", first, 0.2), (policy, repository.branches["main"], 0.3)):
        folder = tmp_path / revision
        commands.run("cronos-train", f"--policy.path={name}", *flags, "--env.benchmark=me/bench",
                     f"--output_dir={folder}")  # fmt: skip
        saved = folder / "checkpoints/last/pretrained_model"
        began_with = json.loads((saved / "train_config.json").read_text())["policy"]
        assert (began_with["pretrained_path"], began_with["pretrained_revision"]) == (policy, revision)
        own = json.loads((saved / "config.json").read_text())
        # It would be looked for where this policy is pushed to.
        assert (own["sigma_init"], own["pretrained_revision"]) == (sigma, None)
        # A processor is saved under its name.
        assert (saved / "new_policy_preprocessor.json").exists() == (revision != first)


# Faults --------------------------------------------------------------------------------------------------


def test_missing_repositories_and_revisions(hub, bench, evaluation, commands):
    results = ("cronos-publish", "results", f"--results={evaluation}", "--repo_id=me/policy")
    for command, said in (
        ((*results, "--benchmark=me/bench@v9"), "no benchmark 'me/bench@v9'"),
        (("cronos-publish", *BENCHMARK, "--pictures=false", "--branch=x", "--revision=v9"), "--revision"),
        (("cronos-eval", "--expert=true", "--env.benchmark=me/nobody"), "no benchmark 'me/nobody'"),
    ):
        assert said in commands.try_(*command).output


def test_a_connection_lost_in_the_middle_of_an_upload(hub, run, commands):
    publish = ("cronos-publish", "stream", f"--root={run / 'streams'}", "--repo_id=me/broken")
    hub.faults.drop_uploads_of = ".mp4"
    lost = commands.try_(*publish, impatient=True)
    assert lost.code == 1
    assert f"error: dataset me/broken on {hub.url}: lost the connection" in lost.output
    assert "Traceback" not in lost.output
    assert hub.tree("datasets", "me/broken") == {}, "there is no half of a dataset"
    uploaded = set(hub.repositories["datasets", "me/broken"].lfs)
    assert uploaded
    hub.faults.drop_uploads_of = None
    hub.requests.clear()
    commands.run(*publish)
    there = hub.tree("datasets", "me/broken")
    assert there == tree(run / "streams") | {"README.md": there["README.md"]}
    again = {request.rsplit("/", 1)[-1] for request in hub.requests if request.startswith("PUT")}
    assert again, "the videos were missing"
    assert not again & uploaded, "what had arrived was not sent again"


def test_a_connection_lost_at_the_commit(hub, bench, commands):
    publish = ("cronos-publish", *BENCHMARK, "--repo_id=me/late")
    hub.faults.drop_commits = 1
    lost = commands.try_(*publish, "--pictures=false")
    assert (lost.code, "run the same command again" in lost.output) == (1, True)
    assert hub.tree("datasets", "me/late") == {}
    commands.run(*publish)
    # The card names its repository, the rest is the same as elsewhere.
    assert hub.tree("datasets", "me/late").keys() == tree(bench).keys()
    commands.run(*publish, "--pictures=false")
    names = {name for name in tree(bench) if not name.startswith("pictures/")}
    assert set(hub.tree("datasets", "me/late")) == names, "nothing is left behind of the larger one"
