"""What a run begins with, where it is pushed to, and what runs that are made from its config take over."""

import json
import sys
from types import SimpleNamespace

import pytest
import torch
from dummies import DummyPolicyConfig, identity_processors
from huggingface_hub.errors import LocalTokenNotFoundError
from lerobot_env_cronos import CronosEnvConfig
from test_cronos_train import OBSERVATIONS, SMALL, cronos_train

from cronos_lerobot.processes import Processes, choose_gpu
from cronos_lerobot.scripts import train as script
from cronos_lerobot.scripts.errors import parse_command_line
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.resume import was_never_told_where_to_push

MODEL = "checkpoints/last/pretrained_model"
OTHERS = [flag for flag in SMALL if not flag.startswith("--policy.hidden")]
AGAIN = [flag for flag in OTHERS if flag != "--policy.type=pocketvla"]


def starts(run):
    return json.loads((run / "manifest.json").read_text())["starts"]


def saved_policy(run):
    return json.loads((run / MODEL / "train_config.json").read_text())["policy"]


def config_file(run):
    return f"--config_path={run / MODEL}/train_config.json"


@pytest.fixture
def base(tmp_path, monkeypatch):
    """A policy of its own, with the repository that it was pushed to in its config."""
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], "--steps=16", f"--output_dir={tmp_path / 'base'}")
    file = tmp_path / "base" / MODEL / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"repo_id": "me/clone", "push_to_hub": True}))
    return file.parent.resolve()


def validated(monkeypatch, *arguments):
    """The config that a command line comes to, without the training."""
    monkeypatch.setattr(sys, "argv", ["cronos-train", *map(str, arguments)])
    config = parse_command_line(CronosTrainConfig, {"algorithm": "ppo"})
    config.validate()
    return config


def test_a_run_made_from_a_resumed_ones_config_begins_with_its_base(base, tmp_path, monkeypatch):
    run, new = tmp_path / "run", tmp_path / "new"
    flags = (*AGAIN, *OBSERVATIONS["state"], f"--policy.path={base}")
    cronos_train(monkeypatch, *flags, "--steps=16", f"--output_dir={run}")
    cronos_train(monkeypatch, "--resume=true", config_file(run), "--steps=32")
    assert saved_policy(run)["pretrained_path"] == str(base)
    began, resumed = starts(run)
    # It did go on with its checkpoint.
    assert began["policy_fingerprint"] != resumed["policy_fingerprint"]
    cronos_train(monkeypatch, config_file(run), "--seed=9", "--steps=16", f"--output_dir={new}")
    (fresh,) = starts(new)
    assert fresh["policy_fingerprint"] == began["policy_fingerprint"]
    # Nor has it another policy's repository, which nobody gave.
    assert (fresh["config"]["policy"]["repo_id"], fresh["config"]["wandb"]["run_id"]) == (None, None)

    # Earlier versions wrote the checkpoint.
    file = run / MODEL / "train_config.json"
    checkpoint = sorted((run / "checkpoints").glob("[0-9]*"))[0] / "pretrained_model"
    content = json.loads(file.read_text())
    content["policy"]["pretrained_path"] = str(checkpoint)
    file.write_text(json.dumps(content))
    message = rf"is of a run that was resumed from {checkpoint}, and a new run .*: give .* as --policy\.path"
    with pytest.raises(ValueError, match=message):
        validated(monkeypatch, config_file(run), f"--output_dir={tmp_path / 'other'}")
    given = validated(monkeypatch, config_file(run), f"--policy.path={base}", f"--output_dir={tmp_path / 'other'}")
    assert given.weights_path == base
    # Such a run goes on.
    assert validated(monkeypatch, config_file(run), "--resume=true").weights_path == (run / MODEL).resolve()


def test_a_run_of_its_own_is_logged_as_one(base, tmp_path, monkeypatch):
    file = base / "train_config.json"
    content = json.loads(file.read_text())
    content["wandb"]["run_id"] = "abc"
    file.write_text(json.dumps(content))
    config = [f"--config_path={file}", f"--output_dir={tmp_path / 'new'}"]
    assert validated(monkeypatch, *config).wandb.run_id is None
    assert validated(monkeypatch, *config, "--wandb.run_id=mine").wandb.run_id == "mine"
    assert validated(monkeypatch, config[0], "--resume=true").wandb.run_id == "abc"


@pytest.mark.parametrize(
    ("flags", "repository", "is_pushed"),
    [
        ((), None, True),  # what it would push has nowhere to go
        (("--policy.push_to_hub=false",), None, False),
        (("--policy.repo_id=me/rl",), "me/rl", True),
        (("--policy.repo_id", "me/rl"), "me/rl", True),
        (("--policy.repo_id=me/clone",), "me/clone", True),
    ],
)
def test_what_a_policy_is_called_on_the_hub_is_not_where_a_run_of_it_goes(
    flags, repository, is_pushed, base, tmp_path, monkeypatch
):
    given = (*AGAIN, *OBSERVATIONS["state"], f"--policy.path={base}", f"--output_dir={tmp_path / 'run'}", *flags)
    policy = validated(monkeypatch, *given).policy
    assert (policy.repo_id, policy.push_to_hub) == (repository, is_pushed)


def test_a_repository_that_is_given_is_pushed_to_or_refused(base, tmp_path, monkeypatch):
    file = base / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"push_to_hub": False}))
    begin = (*AGAIN, *OBSERVATIONS["state"], f"--policy.path={base}", f"--output_dir={tmp_path / 'run'}")
    scratch = (*SMALL, *OBSERVATIONS["state"], f"--output_dir={tmp_path / 'run'}")
    assert validated(monkeypatch, *begin, "--policy.repo_id=me/rl").policy.push_to_hub
    for flags in (begin, scratch, ("--resume=true", f"--config_path={base}")):
        both = r"--policy\.repo_id=me/rl is where .* --policy\.push_to_hub=false pushes nothing: leave one"
        with pytest.raises(ValueError, match=both):
            validated(monkeypatch, *flags, "--policy.repo_id=me/rl", "--policy.push_to_hub=false")
        with pytest.raises(ValueError, match=r"push_to_hub=true pushes nowhere without --policy\.repo_id=<user>"):
            validated(monkeypatch, *flags, "--policy.push_to_hub=true")


def test_a_resumed_run_keeps_to_what_its_first_start_was_told(base, monkeypatch):
    run = base.parents[2]
    resume = ("--resume=true", f"--config_path={base}")
    file, manifest = base / "train_config.json", run / "manifest.json"
    content, (start,) = json.loads(file.read_text()), starts(run)
    content["policy"] |= {"repo_id": "me/clone", "push_to_hub": True}
    file.write_text(json.dumps(content))
    for command, told in (
        (["--policy.path=me/clone"], None),  # as an earlier version wrote it
        (["--policy.path=me/clone", "--policy.repo_id=me/clone"], "me/clone"),
        (["--policy.type=pocketvla", "--policy.repo_id", "me/clone"], "me/clone"),
        (["--policy.path=me/clone", "--config_path=mine.yaml"], "me/clone"),
    ):
        manifest.write_text(json.dumps({"starts": [start | {"command": ["cronos-train", *command]}]}))
        assert was_never_told_where_to_push(base.parent) == (told is None)
        assert validated(monkeypatch, *resume).policy.repo_id == told
        assert validated(monkeypatch, *resume, "--policy.repo_id=me/rl").policy.repo_id == "me/rl"


class Alone(Processes):
    """One process that says when it has left."""

    left = False

    def leave(self):
        self.left = True


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """What calls `train` of a run that is trained at once, with these settings and this error of its push."""

    def train(error, **options):
        def publish(published):
            assert (published.repo_id, published.private) == ("me/rl", True)
            raise error

        policy = SimpleNamespace()
        trainer = SimpleNamespace(
            load=lambda: None, open=lambda: None, train=lambda stop: True,
            agent=SimpleNamespace(save_pretrained=lambda folder: None),
        )  # fmt: skip
        processes = Alone()
        monkeypatch.setattr(script, "join_processes", lambda device: processes)
        made = (policy, *identity_processors())
        monkeypatch.setattr(script, "make_policy_and_processors", lambda config: made)
        monkeypatch.setattr(script, "publish_policy", publish)
        monkeypatch.setattr(script, "make_env", lambda *arguments: SimpleNamespace(close=lambda: None))
        monkeypatch.setattr(script, "Trainer", lambda *arguments: trainer)
        policy_config = DummyPolicyConfig(push_to_hub=True, repo_id="me/rl", private=True)
        config = CronosTrainConfig(CronosEnvConfig(), policy_config, tmp_path / "run", **options)
        try:
            script.train(config)
        finally:
            assert processes.left

    return train


def test_a_run_that_the_hub_refuses_says_what_pushes_it(trained, tmp_path):
    command = f"cronos-publish policy --path={tmp_path / 'run'} --repo_id=me/rl --private=true"
    no_token = LocalTokenNotFoundError("Token is required,\nbut no token found.")
    for error, why in (
        (no_token, "there is no token for .*: set HF_TOKEN, or run `hf auth login`"),
        (OSError(28, "No space left on device"), "No space left on device"),
    ):
        whole = f"^error: the run in {tmp_path / 'run'} is whole but could not be pushed; `{command}` pushes it: "
        with pytest.raises(SystemExit, match=f"{whole}.*{why}$"):
            trained(error)
    with pytest.raises(SystemExit, match=r"--save_checkpoint=false kept none of it: there is no token for "):
        trained(no_token, save_checkpoint=False)
    with pytest.raises(ZeroDivisionError):
        trained(ZeroDivisionError())


def test_the_gpu_of_a_number_is_the_current_one_before_anything_is_drawn(tmp_path, monkeypatch):
    """LeRobot keeps and restores the generator of the current one alone."""
    called = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: called.append(str(device)))
    for device in ("cuda", "cpu", "mps", None):
        choose_gpu(device)
    assert not called
    with pytest.raises(ValueError, match=r"--policy\.device=cuda:2: .* no such GPU; valid ones: cuda:0, cuda:1\."):
        choose_gpu("cuda:2")

    def seeded(seed):
        raise ValueError(f"seeded after {called}")

    monkeypatch.setattr(script, "set_seed", seeded)
    config = CronosTrainConfig(CronosEnvConfig(), DummyPolicyConfig(), tmp_path / "run")
    config.policy.device = "cuda:1"
    with pytest.raises(SystemExit, match=r"seeded after \['cuda:1'\]"):
        script.train(config)


def test_what_is_not_installed_is_one_line(tmp_path, monkeypatch):
    def make(config):
        raise ImportError("'peft' is required but not installed.\nInstall it with: pip install 'lerobot[peft]'")

    monkeypatch.setattr(script, "make_policy_and_processors", make)
    with pytest.raises(SystemExit, match=r"^error: 'peft' is required but not installed\. Install it with: pip "):
        script.train(CronosTrainConfig(CronosEnvConfig(), DummyPolicyConfig(), tmp_path / "run"))
