"""A policy's card: commands that show it what it takes; how it learned, what steers it, what adapters are of."""

import json
import re
import shlex
import shutil

import draccus
import numpy as np
import pytest
import yaml
from flags import parse_flags
from lerobot.configs.types import PolicyFeature
from lerobot_env_cronos.config import CronosEnvConfig
from lerobot_env_cronos.scene.scenes import SCENES
from safetensors.numpy import save_file

from cronos_lerobot.agents.imitation.config import DemosConfig, ImitationConfig
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.evaluation.policy_source import files_fingerprint
from cronos_lerobot.evaluation.results import independent_results
from cronos_lerobot.evaluation.store import FORMAT
from cronos_lerobot.hub import policy as hub_policy
from cronos_lerobot.hub.caveats import changes_of_policy
from cronos_lerobot.hub.config import PolicyConfig
from cronos_lerobot.hub.eval_flags import lerobot_eval_flags
from cronos_lerobot.hub.runs import config_facts
from cronos_lerobot.scripts.publish import publish_policy
from cronos_lerobot.training.config import CronosTrainConfig

STATE = {"obs_type": "environment_state_agent_pos"}
TOLD = STATE | {"task_observation": "one_hot"}


def features_of(env):
    """What LeRobot writes into the config.json of a policy that takes all that `env` shows."""
    features = {env.features_map[name]: feature for name, feature in env.features.items() if name != "action"}
    return {
        name: {"type": f.type.value, "shape": [f.shape[2], *f.shape[:2]] if len(f.shape) == 3 else list(f.shape)}
        for name, f in features.items()
    }


def write_checkpoint(root, kind, env, algorithm, **files):
    """A run of cronos-train with one checkpoint, as far as a card reads it; `files` lie beside the policy."""
    model = root / "run/checkpoints/000032/pretrained_model"
    model.mkdir(parents=True)
    features = {
        "input_features": features_of(env),
        "output_features": {"action": {"type": "ACTION", "shape": [7]}},
    }
    options = {"n_action_steps": 100, "temperature": 0.6}
    (model / "config.json").write_text(json.dumps({"type": kind} | features | options))
    config = json.dumps(draccus.encode(CronosTrainConfig(env=env, algorithm=algorithm)))
    (model / "train_config.json").write_text(config)
    start = {"config": json.loads(config), "environment": "lerobot_env_cronos/kitchen_2x2-v1", "git_commit": None}
    start |= {"command": ["cronos-train"], "versions": {}}
    (root / "run/manifest.json").write_text(json.dumps({"starts": [start]}))
    record = {"kind": "update", "interaction_steps": 32, "interventions": 4, "updates": 1}
    record |= {"interventions_by_kind": {"scene_reset": 4}}
    (root / "run/metrics.jsonl").write_text(json.dumps(record) + "\n")
    tensors = {"weight": np.zeros((2, 2), np.float32)}
    for name, content in ({"model.safetensors": tensors} | files).items():
        save_file(content, model / name) if name.endswith("safetensors") else (model / name).write_text(content)
    return model.parent


def dry_run(checkpoint, out, **flags):
    publish_policy(PolicyConfig(repo_id="me/p", path=checkpoint, dry_run=True, output_dir=out, **flags))
    return (out / "README.md").read_text()


def commands(card):
    """The `--env` flags of each command for evaluating, by its name."""
    blocks = re.findall(r"```bash\n((?:cronos|lerobot)-eval .*?)```", card, re.DOTALL)
    words = [shlex.split(block.replace("\\\n", " ")) for block in blocks]
    assert all(command[1] == "--policy.path=me/p" for command in words)
    return {command[0]: [word.removeprefix("--env.") for word in command if "--env." in word] for command in words}


def shown_by(flags):
    """What the environment of these flags shows, as LeRobot's parser reads them."""
    return features_of(parse_flags(CronosEnvConfig, [f"--{f}" for f in flags if not f.startswith("type=")]))


ADAPTER = {
    "adapter_config.json": json.dumps({"base_model_name_or_path": "/home/me/clone", "revision": "v1", "r": 2}),
    "adapter_model.safetensors": {"weight": np.zeros(2, np.float32)},
}


@pytest.mark.parametrize(
    ("kind", "env", "algorithm", "files", "flags", "said", "tag"),
    [
        ("act", TOLD, ImitationConfig(), {}, {},
         "imitation of its own successes (agent `imitation`)", "imitation"),
        ("pi0", {"camera_name": "front,bridge", "observation_width": 96}, PPOConfig(), ADAPTER,
         {"base_policy": "me/clone"}, "adapters (PEFT) for the policy [me/clone](", "reinforcement"),
        ("diffusion", TOLD | {"scene": "playroom_2x2"}, SteeringConfig(),
         {"steering.safetensors": {"actor": np.zeros(2, np.float32)}}, {},
         "of the noise that it begins with (agent `steering`)", "reinforcement"),
    ],
    ids=["told its task", "adapters", "steered"],
)  # fmt: skip
def test_a_cards_commands_are_right_for_every_policy(
    tmp_path, monkeypatch, kind, env, algorithm, files, flags, said, tag
):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    env = CronosEnvConfig(**env)
    card = dry_run(write_checkpoint(tmp_path, kind, env, algorithm, **files), tmp_path / "out", **flags)
    front = yaml.safe_load(card.split("---")[1])
    assert said in card
    assert f"{tag}-learning" in front["tags"]
    assert ("with the task in `observation.state`" in card) == (env.task_observation == "one_hot")
    given = commands(card)
    assert shown_by(given["lerobot-eval"]) == features_of(env)
    is_steered = "steering.safetensors" in files
    assert list(given) == (["cronos-eval", "lerobot-eval"] if is_steered else ["lerobot-eval"])
    assert not is_steered or given["cronos-eval"] == ["type=cronos", "task_observation=one_hot"]
    assert ("play the policy without the actor" in card) == is_steered
    if files is ADAPTER:
        adapter = json.loads((tmp_path / "out/adapter_config.json").read_text())
        assert adapter == {"base_model_name_or_path": "me/clone", "revision": None, "r": 2}
        assert (front["base_model"], front["base_model_relation"]) == ("me/clone", "adapter")
    # That of the other repository is not known here.
    assert front.get("license") == (None if files is ADAPTER else "apache-2.0")


def test_a_policy_keeps_its_own_license_and_tags(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    model = write_checkpoint(tmp_path, "act", CronosEnvConfig(**STATE), PPOConfig())
    path = tmp_path / "run/checkpoints/000032/pretrained_model/config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"license": "gemma", "tags": ["my-lab"]}))
    for flags, license_ in (({}, "gemma"), ({"license": "mit"}, "mit")):
        front = yaml.safe_load(dry_run(model, tmp_path / license_, **flags).split("---")[1])
        assert front["license"] == license_
        assert front["tags"][-1] == "my-lab"


@pytest.mark.parametrize(
    ("algorithm", "learned"),
    [
        (PPOConfig(), "reinforcement learning (agent `ppo`)"),
        (ImitationConfig(demos=DemosConfig("me/demos"), demos_share=0.5),
         "imitation of its own successes (agent `imitation`)"),
    ],
)  # fmt: skip
def test_a_checkpoint_without_its_run_is_still_of_cronos_train(tmp_path, algorithm, learned):
    """What is recorded is the policy's own, also where the agent has demonstrations beside it."""
    model = write_checkpoint(tmp_path, "pocketvla", CronosEnvConfig(**STATE), algorithm) / "pretrained_model"
    file = model / "train_config.json"
    config = json.loads(file.read_text())
    config["record"]["repo_id"], config["protocol"]["end_effector_reset"] = "me/stream", True
    file.write_text(json.dumps(config))
    card = dry_run(shutil.copytree(model, tmp_path / "copy"), tmp_path / "out")
    assert f"after {learned} with `cronos-train` in the CRONOS scene `kitchen_2x2` (T = 1280, EER):" in card
    assert "interventions, evaluations and curves are in the folder of its run, which was not there" in card
    assert "- What it did while it learned: [me/stream](" in card
    assert "- Observation: privileged state" in card
    for wrong in ("lerobot-train", "Demonstrations", "## Training", "Began"):
        assert wrong not in card
    tags = yaml.safe_load(card.split("---")[1])["tags"]
    assert tags[-2:] == [learned.partition(" ")[0] + "-learning", "reset-free"]


@pytest.mark.parametrize(
    ("env", "flag"),
    [({}, ["renderer=filament"]), (STATE, [])],
    ids=["pictures", "state, of which it draws nothing"],
)
def test_a_cards_command_draws_as_the_training_did(tmp_path, monkeypatch, env, flag):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    env = CronosEnvConfig(**env, renderer="filament")
    card = dry_run(write_checkpoint(tmp_path, "pocketvla", env, PPOConfig()), tmp_path / "out")
    assert [word for word in commands(card)["lerobot-eval"] if "renderer" in word] == flag


def test_a_card_says_how_actions_were_sampled(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "pocketvla", CronosEnvConfig(**STATE), PPOConfig())
    shared = {"kind": "evaluation", "interaction_steps": 32, "success": 0.5, "ci95": [0.1, 0.9], "n": 4}
    with (tmp_path / "run/metrics.jsonl").open("a") as file:
        for interventions, temperature in enumerate((0.6, 0, None)):
            record = shared | {"interventions": interventions, "split": "held_out", "temperature": temperature}
            file.write(json.dumps(record) + "\n")
    lines = [line for line in dry_run(checkpoint, tmp_path / "out").splitlines() if "0.500 [0.100, 0.900]" in line]
    assert lines == [
        f"| 32 | {interventions} | 0.500 [0.100, 0.900] | 4 | held-out | {sampling} |"
        for interventions, sampling in enumerate(("temperature 0.6", "greedy", "the policy's own sampling"))
    ]


PICTURES = {"obs_type": "pixels_agent_pos"}
FILAMENT = "The renderer `filament` drew the policy's pictures"
OTHERS = ", those that it learned from by"


@pytest.mark.parametrize(
    ("renderer", "changes", "told"),
    [
        ("classic", PICTURES | {"renderer": "classic"}, []),
        ("classic", STATE | {"renderer": "filament"}, []),
        ("classic", PICTURES | {"renderer": "filament"}, [f"{FILAMENT}{OTHERS} `classic`."]),
        ("filament", PICTURES | {"renderer": "filament"}, [f"{FILAMENT}."]),
        ("filament", PICTURES, [f"The renderer `classic` drew the policy's pictures{OTHERS} `filament`."]),
        ("classic", {"repetitions": 4}, ["Every configuration of the independent suite was run 4 times."]),
        ("classic", {"config": {"quick": True, "eval": {"n_episodes": None}}, "identity": {"n_episodes": 16}},
         ["Evaluated on the first 16 configurations of each split."]),
        ("classic", {"config": {"policy": {"type": "act", "n_action_steps": 1, "device": "cuda", "newer": 2}}},
         ["Flags changed the policy: n_action_steps 1 in place of 100."]),
    ],
)  # fmt: skip
def test_a_card_says_in_what_its_scores_are_of_something_else(tmp_path, monkeypatch, renderer, changes, told):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    env = CronosEnvConfig(renderer=renderer)
    checkpoint = write_checkpoint(tmp_path, "act", env, ImitationConfig())
    card = dry_run(checkpoint, tmp_path / "out", results=write_scores(tmp_path / "eval", **changes))
    above, table = card.partition("## Results\n")[2].split("| suite and split |")
    assert [line[2:] for line in above.splitlines() if line.startswith("- ")] == told
    assert "| independent, train | success | 1.000 " in table


def test_what_flags_changed_of_a_policy():
    published = {"type": "pi0_fast", "temperature": 0.0, "device": "cpu", "push_to_hub": True, "dtype": "float32",
                 "adapter": None, "use_peft": True}  # fmt: skip
    assert changes_of_policy({}, published) == []
    evaluated = {"type": "pi0_fast", "temperature": 0.5, "device": "cuda", "push_to_hub": False, "use_peft": False,
                 "dtype": "bfloat16", "adapter": "/home/me/lora", "newer": 1}  # fmt: skip
    results = {"config": {"policy": evaluated}, "temperature": 0.6}
    others = ["dtype bfloat16 in place of float32", "adapter a folder in place of null"]
    assert changes_of_policy(results, published) == others
    # Of a policy that the evaluation gives no temperature its own one holds.
    own = ["temperature 0.5 in place of 0.0"]
    assert changes_of_policy(results | {"temperature": None}, published) == own + others


def write_scores(folder, **changes):
    """results.json of two episodes, of one suite, on a benchmark in a folder of the user's."""
    task = SCENES["kitchen_2x2"].tasks[0]
    one = {"configuration": 0, "length": 1, "found_complete": [], "never_grasped": []}
    environment = "lerobot_env_cronos/kitchen_2x2-v1"
    results = {
        "format": FORMAT, "policy": "outputs/run", "policy_files": None, "scene": "kitchen_2x2", "seed": 3,
        "temperature": None, "advance": "window", "end_effector_reset": False,
        "benchmark": {"environment": environment, "source": "/home/me/secret/bench", "fingerprint": "f"},
        "independent": {"train": independent_results([one | {"number": 0}] * 2, [task])},
    } | changes  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps(results))
    return folder


def test_the_scores_of_one_suite_are_on_the_card_and_no_folder_of_the_users(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "act", CronosEnvConfig(**STATE), ImitationConfig())
    files = files_fingerprint(checkpoint / "pretrained_model")
    card = dry_run(checkpoint, tmp_path / "out", results=write_scores(tmp_path / "eval", policy_files=files))
    assert "| independent, train | success | 1.000 " in card
    assert "benchmark `a local benchmark`, the policy's own sampling, seed 3" in card
    assert "/home/me" not in card


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy": "scripted expert"}, "is of scripted expert, whose weights are not those of"),
        ({"policy": "outputs/other", "policy_files": "0123"}, "is of outputs/other, whose weights are not those"),
        ({"scene": "playroom_2x2"}, "is of playroom_2x2, the policy of kitchen_2x2"),
    ],
    ids=["expert", "other weights", "other scene"],
)
def test_scores_of_something_else_are_refused(tmp_path, monkeypatch, changes, message):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "act", CronosEnvConfig(**STATE), ImitationConfig())
    with pytest.raises(ValueError, match=message):
        dry_run(checkpoint, tmp_path / "out", results=write_scores(tmp_path / "eval", **changes))
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))


def test_a_card_says_what_a_resume_changed(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "pocketvla", CronosEnvConfig(**STATE), PPOConfig())
    manifest = tmp_path / "run/manifest.json"
    (start,) = json.loads(manifest.read_text())["starts"]
    again = json.loads(json.dumps(start))
    again["config"]["protocol"]["scene_reset_interval"] = 320
    manifest.write_text(json.dumps({"starts": [start, again, again]}))
    changed = "protocol.scene_reset_interval=1280, then 320"
    (tmp_path / "out").mkdir()  # by hand
    assert f"| flags that a resume changed | {changed} |" in dry_run(checkpoint, tmp_path / "out")
    # A checkpoint of before has nothing of it.
    step = int(checkpoint.name)
    for began, told in ((step - 1, changed), (step, "none")):
        manifest.write_text(json.dumps({"starts": [start, again | {"interaction_steps": began}]}))
        card = dry_run(checkpoint, tmp_path / f"out_{began}")
        assert f"| flags that a resume changed | {told} |" in card


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        # T has its default there, too.
        ({"scene_reset": "critic", "reset_budget": 100}, {"scene reset": "asked for by the critic"}),
        ({"scene_reset_interval": None}, {"scene reset": "never"}),
        ({"reset_phase": "staggered", "takeover_after": 2, "takeover_price": 3, "takeover_budget": 60},
         {"scene reset": "every 1280 steps of a stream", "phase of scene resets": "staggered",
          "takeovers": "after 2 failures in a row, each counts as 3, at most 60 interventions in all"}),
        ({"takeover_after": 2},
         {"scene reset": "every 1280 steps of a stream",
          "takeovers": "after 2 failures in a row, each counts as 1"}),
    ],
)  # fmt: skip
def test_a_card_says_who_resets_and_who_takes_over(tmp_path, monkeypatch, changes, told):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "pocketvla", CronosEnvConfig(**STATE), PPOConfig())
    manifest = tmp_path / "run/manifest.json"
    (start,) = json.loads(manifest.read_text())["starts"]
    start["config"]["protocol"] |= changes
    manifest.write_text(json.dumps({"starts": [start]}))
    rows = dict(re.findall(r"^\| ([^|]*) \| ([^|]*) \|$", dry_run(checkpoint, tmp_path / "out"), re.MULTILINE))
    asked = ("scene reset", "phase of scene resets", "takeovers")
    assert {name: rows[name] for name in asked if name in rows} == told


def test_a_run_that_is_older_than_the_flags_has_facts_too():
    config = json.loads(json.dumps(draccus.encode(CronosTrainConfig(env=CronosEnvConfig(**STATE)))))
    for name in ("scene_reset", "reset_phase", "takeover_after", "takeover_price", "takeover_budget"):
        del config["protocol"][name]
    facts = config_facts(config)
    told = facts["scene_resets"], facts["reset_phase"], facts["takeovers"]
    assert told == ("every 1280 steps of a stream", None, None)


def test_a_card_of_a_run_that_began_with_a_folder_names_no_repository(tmp_path, monkeypatch):
    """Which looks like one, `<folder>/<folder>`, and is not there where the card is made."""
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "pocketvla", CronosEnvConfig(**STATE), PPOConfig())
    manifest = tmp_path / "run/manifest.json"
    (start,) = json.loads(manifest.read_text())["starts"]
    start["config"]["policy"] = {"pretrained_path": "outputs/clone"}
    for fingerprint, named in ((None, True), ("0123456789abcdef", False)):
        manifest.write_text(json.dumps({"starts": [start | {"policy_fingerprint": fingerprint}]}))
        card = dry_run(checkpoint, tmp_path / f"out_{named}")
        assert ("base_model: outputs/clone" in card, "/outputs/clone)" in card) == (named, named)


def test_adapters_of_a_policy_that_nobody_else_has_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "pi0", CronosEnvConfig(), PPOConfig(), **ADAPTER)
    with pytest.raises(ValueError, match=r"adapters of the policy in /home/me/clone, a folder .*--base_policy="):
        dry_run(checkpoint, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match=r"--base_policy=clone is no <owner>/<name>"):
        dry_run(checkpoint, tmp_path / "out", base_policy="clone")
    # As it was named where the run was started, and this command is not.
    adapter = checkpoint / "pretrained_model/adapter_config.json"
    adapter.write_text(json.dumps({"base_model_name_or_path": "outputs/clone"}))
    (tmp_path / "outputs/clone").mkdir(parents=True)
    with pytest.raises(ValueError, match="the policy in outputs/clone"):
        dry_run(checkpoint, tmp_path / "out")
    # A repository stays.
    adapter.write_text(json.dumps({"base_model_name_or_path": "lerobot/pi0", "revision": "v2"}))
    assert "[lerobot/pi0](" in dry_run(checkpoint, tmp_path / "out")
    assert (tmp_path / "out/adapter_config.json").read_text() == adapter.read_text()


@pytest.mark.parametrize(
    ("size", "scene", "told"), [(18, None, True), (13, "kitchen_2x2", False), (20, None, True)]
)
def test_the_size_of_a_cloned_policys_state_says_whether_it_is_told_its_task(size, scene, told):
    """13 numbers are the robot's; 2 objects and 3 receptacles with the table make 18, 3 and 4 make 20."""
    features = {"observation.state": PolicyFeature("STATE", (size,)).__dict__}
    flags = lerobot_eval_flags({"input_features": features}, {}, scene)
    assert ("--env.task_observation=one_hot" in flags) == told
