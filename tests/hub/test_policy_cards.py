"""A policy's card: commands that show it what it takes, its configuration and its numbers."""

import json
import shutil

import numpy as np
import pytest
import yaml
from flags import parse_flags
from lerobot_env_cronos.config import CronosEnvConfig
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX
from synthetic_evaluations import write_evaluation
from synthetic_runs import edit_lines, edit_starts

from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.evaluation.policy_source import files_fingerprint
from cronos_lerobot.hub.checkpoint import environment_flags, find_checkpoint, is_repository
from policies import STATE, STEPS, commands, dry_run, features_of, rows, train_config, write_model, write_run

TOLD = STATE | {"task_observation": "one_hot"}
ADAPTER = {
    "adapter_config.json": json.dumps({"base_model_name_or_path": "/home/me/clone", "revision": "v1", "r": 2}),
    "adapter_model.safetensors": {"weight": np.zeros(2, np.float32)},
}
ACTOR = {"steering.safetensors": {"actor": np.zeros(2, np.float32)}}


def front(card):
    return yaml.safe_load(card.split("---")[1])


@pytest.mark.parametrize(
    ("env", "algorithm", "files", "flags"),
    [
        (TOLD, ImitationConfig(), {}, {}),
        (
            {"camera_name": "front,bridge", "observation_width": 96},
            PPOConfig(),
            ADAPTER,
            {"base_policy": "me/clone"},
        ),
        (TOLD | {"scene": "playroom_2x2"}, SteeringConfig(), ACTOR, {}),
        ({"renderer": "filament"}, PPOConfig(), {}, {}),
    ],
    ids=["told its task", "adapters", "steered", "another renderer"],
)
def test_a_cards_commands_are_right_for_every_policy(tmp_path, env, algorithm, files, flags):
    env = CronosEnvConfig(**env)
    card = dry_run(write_run(tmp_path, env, algorithm, files=files), tmp_path / "out", **flags)
    given = commands(card)
    # LeRobot's own command would play the policy without the actor.
    assert list(given) == (["cronos-eval"] if files is ACTOR else ["cronos-eval", "lerobot-eval"])
    for words in given.values():
        flags_ = [word.replace("--env.", "--") for word in words if "--env." in word]
        shown = parse_flags(CronosEnvConfig, [flag for flag in flags_ if not flag.startswith("--type=")])
        assert features_of(shown) == features_of(env)
        assert (shown.scene, shown.renderer) == (env.scene, env.renderer)
        assert words[0] == "--policy.path=me/p"
    if files is ADAPTER:
        adapter = json.loads((tmp_path / "out/adapter_config.json").read_text())
        assert adapter == {"base_model_name_or_path": "me/clone", "revision": None, "r": 2}
        assert (front(card)["base_model"], front(card)["base_model_relation"]) == ("me/clone", "adapter")
    # The license of the other repository is not known here.
    assert front(card).get("license") == (None if files is ADAPTER else "apache-2.0")


def test_a_policy_keeps_its_own_license_and_tags(tmp_path):
    tags = ["stage: 2", "#sim", "no", "1.0", "@home"]
    model = write_model(tmp_path / "model", license="gemma", tags=tags)
    for flags, license_ in (({}, "gemma"), ({"license": "mit"}, "mit")):
        card = front(dry_run(model, tmp_path / license_, **flags))
        assert card["license"] == license_
        assert card["tags"][-5:] == tags


def test_the_numbers_and_the_configuration_of_a_run(tmp_path):
    env = CronosEnvConfig(**STATE, scene="playroom_2x2")
    run = write_run(tmp_path, env, PPOConfig())
    card = dry_run(run, tmp_path / "out")
    assert f"- Interaction steps: {STEPS}\n" in card
    # 8 streams of 1,280 steps each, with a scene reset every 320.
    assert "- Interventions: 32\n" in card
    cells = rows(card)
    assert ["scene reset", "32", "yes"] in cells
    assert ["initial", "8", "no"] in cells
    assert ["--env.scene", "playroom_2x2"] in cells
    assert not [row for row in cells if row[0] == "--protocol.task_switch_interval"], "it has its default"
    assert [row[0] for row in cells if len(row) == 6 and row[0].isdigit()] == ["0", str(STEPS // 2), str(STEPS)]


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/somewhere/cronos_lerobot/bases/kitchen_2x2_state", "kitchen_2x2_state"),
        ("me/policy", "me/policy"),
        ("outputs/act/checkpoints/last/pretrained_model", "act last"),
        (None, None),
    ],
)
def test_a_training_is_pushed_with_its_policy(path, name, tmp_path):
    run = write_run(tmp_path)
    config = train_config(CronosEnvConfig(**STATE), seed=3) | {"policy": {"pretrained_path": path}}
    edit_starts(run, lambda starts: starts[0].update(config=config, policy_fingerprint="bbfc"))
    dry_run(run, tmp_path / "out")
    assert json.loads((tmp_path / "out/cronos_training.json").read_text()) == {
        "interaction_steps": STEPS, "interventions": 32, "seed": 3, "base": name, "base_fingerprint": "bbfc",
    }  # fmt: skip


def test_a_checkpoint_in_the_middle_has_what_came_before_it(tmp_path):
    run = write_run(tmp_path, step=STEPS // 2)
    edit_starts(run, lambda starts: starts.append(starts[0] | {"interaction_steps": STEPS // 2}))
    card = dry_run(run / "checkpoints" / f"{STEPS // 2:07d}", tmp_path / "out")
    assert f"- Interaction steps: {STEPS // 2}\n- Interventions: 16\n" in card
    shutil.move(run / "checkpoints" / f"{STEPS // 2:07d}", run / "checkpoints/0000099")
    with pytest.raises(ValueError, match="nothing at step 99"):
        find_checkpoint(run / "checkpoints/0000099")


def test_a_checkpoint_without_its_run_has_a_configuration_and_no_numbers(tmp_path):
    trained = train_config(CronosEnvConfig(**STATE), ImitationConfig())
    trained["record"]["repo_id"], trained["protocol"]["scene_reset_interval"] = "me/stream", None
    card = dry_run(write_model(tmp_path / "model", trained=trained), tmp_path / "out")
    assert ["--protocol.scene_reset_interval", "null"] in rows(card)
    assert front(card)["datasets"] == ["me/stream"]
    assert "reset-free" in front(card)["tags"]
    assert "Interventions" not in card


def test_scores_are_those_of_these_weights(tmp_path):
    model = write_model(tmp_path / "model", trained={"env": {"scene": "kitchen_2x2"}}, n_action_steps=100)
    files = files_fingerprint(model, with_base=False)
    evaluated = {"policy_files": files, "policy_config": {"type": "act", "n_action_steps": 1, "device": "cuda"}}
    write_evaluation(
        tmp_path / "eval", "outputs/run", tasks=["1111", "0011", "1010", "1111"], total=64, **evaluated
    )
    write_evaluation(tmp_path / "eval", "outputs/run", chains=[[4, 2], [0, 2]], **evaluated)
    card = dry_run(model, tmp_path / "out", results=tmp_path / "eval")
    (success,) = [row for row in rows(card) if row[:3] == ["independent", "held_out", "success"]]
    assert (success[3][:6], success[4]) == ("0.750 ", "16")
    chains = [row[3][:5] for row in rows(card) if row[0] == "sequential"]
    assert chains == ["0.750", "0.750", "0.250", "0.250", "2.00 "]
    for said in ("16 of the 64 episodes of held_out", "n_action_steps 1 instead of 100"):
        assert said in card
    write_evaluation(tmp_path / "other", "outputs/other", tasks=["1"], policy_files="0123")
    with pytest.raises(ValueError, match="--results="):
        dry_run(model, tmp_path / "refused", results=tmp_path / "other")
    assert not (tmp_path / "refused").exists()


def test_a_run_that_began_with_a_folder_names_no_repository(tmp_path):
    """The folder looks like a repository, and is not there where the card is made."""
    run = write_run(tmp_path)
    for fingerprint, base in ((None, "outputs/clone"), ("0123456789abcdef", None)):
        config = {"policy": {"pretrained_path": "outputs/clone"}}
        edit_starts(
            run, lambda s, f=fingerprint, c=config: s[0].update(policy_fingerprint=f, config=s[0]["config"] | c)
        )
        assert front(dry_run(run, tmp_path / f"out_{base is None}")).get("base_model") == base


def test_adapters_of_a_policy_that_nobody_else_has_are_refused(tmp_path):
    model = write_model(tmp_path / "run/model", files=ADAPTER)
    with pytest.raises(ValueError, match="--base_policy="):
        dry_run(model, tmp_path / "out")
    with pytest.raises(ValueError, match="--base_policy=clone"):
        dry_run(model, tmp_path / "out", base_policy="clone")
    # The name is relative to where the run was started.
    adapter = model / "adapter_config.json"
    adapter.write_text(json.dumps({"base_model_name_or_path": "outputs/clone"}))
    write_model(tmp_path / "outputs/clone")
    with pytest.raises(ValueError, match="--base_policy="):
        dry_run(model, tmp_path / "out")
    adapter.write_text(json.dumps({"base_model_name_or_path": "lerobot/pi0", "revision": "v2"}))
    assert front(dry_run(model, tmp_path / "out"))["base_model"] == "lerobot/pi0"
    assert (tmp_path / "out/adapter_config.json").read_text() == adapter.read_text()


@pytest.mark.parametrize(
    ("size", "scene", "told"), [(18, None, True), (13, "kitchen_2x2", False), (20, None, True)]
)
def test_the_size_of_a_cloned_policys_state_says_whether_it_is_told_its_task(size, scene, told):
    """13 numbers are the robot's; 2 objects and 3 receptacles with the table make 18, 3 and 4 make 20."""
    features = {"observation.state": {"type": "STATE", "shape": [size]}}
    flags = environment_flags({"input_features": features}, {}, scene)
    assert ("--env.task_observation=one_hot" in flags) == told


def test_what_a_clone_renamed_is_in_its_commands(tmp_path):
    names = {
        f"observation.images.{camera}": f"observation.images.camera{i}" for i, camera in enumerate(WIDOWX.cameras)
    }
    env = CronosEnvConfig(camera_name=",".join(WIDOWX.cameras))
    features = {names.get(key, key): feature for key, feature in features_of(env).items()}
    model = write_model(tmp_path / "clone", features, {"rename_map": names, "dataset": {"repo_id": "me/demos"}})
    card = dry_run(model, tmp_path / "out", scene="kitchen_3x3")
    assert front(card)["datasets"] == ["me/demos"]
    for words in commands(card).values():
        (renamed,) = [word for word in words if word.startswith("--rename_map=")]
        assert json.loads(renamed.partition("=")[2]) == names
        assert {"--env.scene=kitchen_3x3", "--env.camera_name=front,bridge"} <= set(words)
    with pytest.raises(ValueError, match="kichen_2x2"):
        dry_run(model, tmp_path / "typo", scene="kichen_2x2")


def test_where_a_policy_may_be(tmp_path):
    run = write_run(tmp_path)
    model = run / f"checkpoints/{STEPS:07d}/pretrained_model"
    for path in (run, model.parent, model):
        found, logged = find_checkpoint(path)
        assert (found, logged.folder) == (model, run)
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/pretrained_model").symlink_to(model)
    with pytest.raises(ValueError, match="--path="):
        find_checkpoint(tmp_path / "theirs")
    (run / "metrics.jsonl").unlink()
    assert find_checkpoint(run) == (model, None), "it is lerobot-train's"
    with pytest.raises(FileNotFoundError, match="--path="):
        find_checkpoint(tmp_path)


def test_what_can_be_a_repository(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs/clone").mkdir(parents=True)
    assert is_repository("me/base")
    assert not any(map(is_repository, ("outputs/clone", "./base", "/me/base", "a/b/c", None, "base")))


# Runs of other people ------------------------------------------------------------------------------------

TOKEN = "hf_" + "x7Q" * 11


def test_nothing_private_or_foreign_is_pushed(tmp_path, monkeypatch, capsys):
    """A token beside the policy and in its config, notes for W&B, home folders, and a flag that goes on."""
    monkeypatch.setenv("HOME", "/home/melanie")
    model = {"pretrained_path": "/home/melanie/base"}
    run = write_run(tmp_path, files={".env": TOKEN, "id_rsa": "KEY", "policy_preprocessor_key": "KEY"}, **model)
    folder = run / f"checkpoints/{STEPS:07d}/pretrained_model"
    trained = json.loads((folder / "train_config.json").read_text())
    trained |= {"output_dir": "/home/melanie/secret/run", "job_name": TOKEN}
    trained["wandb"] |= {"notes": "ask Bob for the grant", "entity": "lab"}
    trained["env"]["benchmark"] = "a\n```\n# Injected\n/scratch/melanie/bench"
    (folder / "train_config.json").write_text(json.dumps(trained))
    card = dry_run(run, tmp_path / "out")
    names = {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert names == {"README.md", "config.json", "train_config.json", "model.safetensors", "cronos_training.json"}
    pushed = b"".join((tmp_path / "out" / name).read_bytes() for name in names)
    for secret in (TOKEN, "melanie", "grant", "KEY"):
        assert secret.encode() not in pushed
    assert "# Injected" not in card.splitlines()
    assert "not pushed: .env, id_rsa, policy_preprocessor_key\n" in capsys.readouterr().out
    secret = tmp_path / "id_rsa"
    secret.write_text("KEY")
    (folder / "tokenizer.json").symlink_to(secret)
    with pytest.raises(ValueError, match=r"tokenizer\.json leads out"):
        dry_run(run, tmp_path / "refused")
    assert not (tmp_path / "refused").exists()


@pytest.mark.parametrize("wrong", [[], {"type": "act", "input_features": [1]}, {"type": "act", "tags": 5}])
def test_a_damaged_policy_is_named(tmp_path, wrong):
    model = write_model(tmp_path / "model")
    (model / "config.json").write_text(json.dumps(wrong))
    with pytest.raises(ValueError, match="damaged"):
        dry_run(model, tmp_path / "out")


def test_damaged_weights_and_metrics_are_named(tmp_path):
    run = write_run(tmp_path)
    edit_lines(run, lambda lines: lines[-1].update(ci95="no"))
    with pytest.raises(ValueError, match="damaged"):
        dry_run(run, tmp_path / "out")
    weights = run / f"checkpoints/{STEPS:07d}/pretrained_model/model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])
    with pytest.raises(ValueError, match=r"damaged"):
        dry_run(weights.parent, tmp_path / "out")
