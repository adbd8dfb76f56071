"""A resumed run follows a flag or refuses it, by one table; a stop between two updates is none."""

import dataclasses
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from dummies import DummyPolicyConfig
from lerobot.configs.parser import PluginLoadError
from lerobot_env_cronos import CronosEnvConfig
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_trainer import STEPS_PER_UPDATE, assert_same_run, config, make_trainer, metrics, train

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.report.runs import read_training_run
from cronos_lerobot.stopwatch import Stopwatch
from cronos_lerobot.training import resume
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.logging import MetricsFile, RunLogger
from cronos_lerobot.training.record_config import RecordConfig
from cronos_lerobot.training.recording import StreamObserver
from cronos_lerobot.training.seeding import NamedGenerators

DOCS = Path(__file__).parents[2] / "docs/training.md"


def flags(config_class, prefix=""):
    """Every flag of a config and, of its parts, of the classes that cronos-train has there."""
    parts = {"env": CronosEnvConfig, "policy": DummyPolicyConfig, "algorithm": PPOConfig}
    for field in dataclasses.fields(config_class):
        if not field.init:
            continue
        value = parts.get(prefix + field.name) or field.default_factory
        if dataclasses.is_dataclass(value):
            yield from flags(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name


def test_every_flag_is_followed_or_refused():
    names = [*flags(CronosTrainConfig), "env.type", "policy.type", "policy.path", "algorithm.type"]
    assert len(names) > 90
    unknown = []
    for name in names:
        try:
            assert resume.rule_of(name) in (resume.FOLLOWED, resume.REFUSED)
        except KeyError:
            unknown.append(name)
    assert not unknown, "say in training/resume.py and docs/training.md what a resumed run does with them"
    with pytest.raises(KeyError):
        resume.rule_of("record.no_such_flag")


def test_the_docs_have_the_table():
    documented = {}
    for rule in (resume.FOLLOWED, resume.REFUSED):
        (line,) = re.findall(rf"^\| {rule} \| (.*?) \|$", DOCS.read_text(), re.MULTILINE)
        documented |= dict.fromkeys(re.findall(r"`--([^`]+)`", line), rule)
    assert documented == resume.FLAGS


def resumed(folder, **options):
    cfg = config(folder, **options)
    cfg.checkpoint_path = (folder / "checkpoints/last").resolve()
    return cfg


REFUSALS = {
    "--seed=6, but the run that is resumed has 5": {"seed": 6},
    "--record.repo_id=me/stream, but .* has null": {"record": RecordConfig(repo_id="me/stream")},
    "--algorithm.kl_base_coef=0.0, but .* has 0.1": {
        "algorithm": PPOConfig(minibatch_size=16, policy_lr=1e-2, policy_lr_max=1.0)
    },
    "--protocol.learned_reset=true, but .* has false": {
        "protocol": ProtocolConfig(4, 8, 16, task_order="random", learned_reset=True)
    },
    "--steps=32, but the run has done 64 steps": {"steps": 32},
}


def test_what_is_refused_is_named_with_both_values(tmp_path):
    train(config(tmp_path / "run", steps=2 * STEPS_PER_UPDATE, eval_freq=0))
    for message, options in REFUSALS.items():
        with pytest.raises(ValueError, match=message):
            make_trainer(resumed(tmp_path / "run", **options)).load()


@pytest.mark.parametrize("flag", [["--policy.pretrained_path=/other"], ["--policy.pretrained_path", "/other"]])
def test_the_policy_that_a_run_began_with_is_not_given_again(flag, tmp_path):
    train(config(tmp_path, steps=STEPS_PER_UPDATE))
    with pytest.raises(ValueError, match=r"^--policy\.pretrained_path=/other, but the run that is resumed has"):
        resume.check_types(tmp_path / "checkpoints/last", flag)


def test_generators_of_another_device_begin_with_numbers_of_the_step():
    """A generator of CUDA has a state of 16 bytes, one of the CPU 5,056."""

    def draws(state, step):
        generators = NamedGenerators(5)
        generator, rng = generators.for_torch("actions"), generators.for_numpy("tasks")
        if state is not None:
            generators.load_state_dict(state, step)
        return torch.rand(3, generator=generator).tolist(), rng.random(3).tolist()

    first, saved = draws(None, 0), NamedGenerators(5)
    saved.for_numpy("tasks").random(3)
    torch.rand(3, generator=saved.for_torch("actions"))
    same = saved.state_dict()
    other = same | {"torch": {"actions": [0] * 16}}
    went_on = draws(same, 40)
    assert draws(same, 80) == went_on
    assert went_on[0] != first[0]
    # NumPy's go on, whatever the device.
    assert draws(other, 40)[1] == went_on[1] != first[1]
    assert draws(other, 40) == draws(other, 40)
    different = [draws(other, 40)[0], draws(other, 80)[0], went_on[0], first[0]]
    assert len(set(map(tuple, different))) == 4


def test_a_run_of_another_version_is_refused(tmp_path):
    train(config(tmp_path / "run", steps=STEPS_PER_UPDATE, eval_freq=0))
    path = tmp_path / "run/checkpoints/last/training_state" / resume.RUN
    path.write_text(
        json.dumps(json.loads(path.read_text()) | {"environment": "lerobot_env_cronos/kitchen_2x2-v0"})
    )
    with pytest.raises(ValueError, match=r"kitchen_2x2-v0; this is version 1.*begin a new run"):
        make_trainer(resumed(tmp_path / "run")).load()
    path.unlink()
    with pytest.raises(ValueError, match="does not say which version"):
        make_trainer(resumed(tmp_path / "run")).load()


def test_a_learning_rate_that_is_given_is_the_optimizers(tmp_path):
    """The other one stays what the run has made of it."""
    algorithm = PPOConfig(minibatch_size=16, policy_lr=1e-2, policy_lr_max=1.0, kl_base_coef=0.1)
    train(config(tmp_path / "run", steps=3 * STEPS_PER_UPDATE, eval_freq=0, algorithm=algorithm))
    state = tmp_path / "run/checkpoints/last/training_state"
    for given, expected in (({}, None), ({"policy_lr": 3e-4, "beta1": 0.5}, 3e-4)):
        changed = dataclasses.replace(algorithm, **given)
        trainer = make_trainer(resumed(tmp_path / "run", algorithm=changed))
        trainer.load()
        groups = {group["name"]: group for group in trainer.agent.optimizer.param_groups}
        saved = json.loads((state / "optimizer_param_groups.json").read_text())
        before = {group["name"]: group for group in saved}
        assert groups["policy"]["lr"] == (before["policy"]["lr"] if expected is None else expected)
        assert groups["policy"]["betas"][0] == (0.9 if expected is None else 0.5)
        assert groups["value"]["lr"] == 1e-3


def test_a_run_belongs_to_what_its_benchmark_is_whatever_release_it_came_with(tmp_path, monkeypatch):
    train(config(tmp_path / "run", steps=STEPS_PER_UPDATE, eval_freq=0))
    path = tmp_path / "run/checkpoints/last/training_state" / resume.RUN
    began = {"source": "lerobot_env_cronos 0.2.0", "fingerprint": "abc"}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"benchmark": began}))
    for fingerprint in ("abc", "abd"):
        now = {
            "environment": None,
            "benchmark": {"source": "lerobot_env_cronos 0.2.1", "fingerprint": fingerprint},
        }
        monkeypatch.setattr(resume, "describe_environment", lambda env, now=now: now)
        if fingerprint == "abc":
            make_trainer(resumed(tmp_path / "run")).load()
        else:
            with pytest.raises(ValueError, match=r"0\.2\.0.*'abc'.*now is .*0\.2\.1.*'abd'"):
                make_trainer(resumed(tmp_path / "run")).load()


def test_a_recording_that_is_refused_leaves_the_metrics_as_they_were(tmp_path, monkeypatch):
    train(config(tmp_path / "run", eval_freq=0))
    first = sorted((tmp_path / "run/checkpoints").glob("[0-9]*"))[0]
    before = (tmp_path / "run/metrics.jsonl").read_bytes()

    def refuse(*args):
        raise ValueError("another process has it")

    monkeypatch.setattr(StreamObserver, "open", refuse)
    cfg = resumed(tmp_path / "run")
    cfg.checkpoint_path = first
    trainer = make_trainer(cfg)
    with pytest.raises(ValueError, match="another process has it"):
        trainer.train()
    assert (tmp_path / "run/metrics.jsonl").read_bytes() == before


def test_the_runs_plugins_are_imported_unless_others_are_given(tmp_path, monkeypatch):
    for name in ("my_first", "my_second", "my_own"):
        (tmp_path / f"{name}.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    starts = [
        ["cronos-train", "--discover_packages_path=my_first", "--protocol.discover_packages_path", "my_second"]
    ]
    starts += [["cronos-train", "--resume=true"]]
    manifest = tmp_path / "run" / resume.MANIFEST
    checkpoint = tmp_path / "run/checkpoints/000016"
    # A checkpoint by itself has no manifest.
    resume.import_plugins(checkpoint, [])
    manifest.parent.mkdir()
    manifest.write_text(json.dumps({"starts": [{"command": command} for command in starts]}))
    resume.import_plugins(checkpoint, ["--protocol.discover_packages_path=my_own"])
    assert sys.modules.pop("my_first")
    assert "my_second" not in sys.modules
    (tmp_path / "my_second.py").unlink()
    with pytest.raises(PluginLoadError, match=r"--protocol.discover_packages_path=my_second: .* No module"):
        resume.import_plugins(checkpoint, [])
    sys.modules.pop("my_first")


DAMAGED = {
    "training_state/loop.json": "loop.json",
    "training_state/env_state.npz": "env_state.npz",
    "training_state/observers.pt": "observers.pt",
    "training_state/agent.pt": "agent.pt",
    "training_state/run.json": "run.json",
    "training_state/optimizer_state.safetensors": "optimizer_state.safetensors",
    "pretrained_model/model.safetensors": "model.safetensors",
}


def test_a_damaged_file_of_a_checkpoint_is_named(tmp_path):
    train(config(tmp_path / "run", steps=STEPS_PER_UPDATE, eval_freq=0))
    for path, name in DAMAGED.items():
        file = tmp_path / "run/checkpoints/last" / path
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ValueError, match=f"{name} is damaged"):
            make_trainer(resumed(tmp_path / "run")).load()
        file.write_bytes(whole)


def budget(reset_budget):
    """T = 12 and U = 8: the first scene reset, which spends the budget, lies between two updates."""
    protocol = ProtocolConfig(
        task_switch_interval=4, update_interval=8, scene_reset_interval=12, task_order="random",
        reset_budget=reset_budget,
    )  # fmt: skip
    return {"protocol": protocol, "eval_freq": 0, "save_freq": 0}


def test_a_run_that_a_budget_stopped_goes_on_as_if_it_had_not(tmp_path):
    train(config(tmp_path / "whole", **budget(None)))
    stopped = train(config(tmp_path / "stopped", **budget(4)))
    assert (stopped.loop.t, stopped.loop.updates, stopped.agent.buffer.rows) == (12, 1, 4)
    # Of what it had come to there is a record until it goes on.
    end = read_training_run(tmp_path / "stopped").last
    assert (end["kind"], end["interaction_steps"], end["interventions"]) == ("end", 48, 5)
    torch.manual_seed(999)
    train(resumed(tmp_path / "stopped", **budget(None)), policy_seed=8)
    assert_same_run(tmp_path / "whole", tmp_path / "stopped")
    assert len(metrics(tmp_path / "stopped")) == 4


def test_the_speed_after_such_a_stop_is_that_of_the_steps_that_were_left(tmp_path, monkeypatch):
    """Each lap takes a second."""
    monkeypatch.setattr(Stopwatch, "lap", lambda self: (1.0, {}))
    train(config(tmp_path / "run", **budget(4)))
    train(resumed(tmp_path / "run", **budget(None)), policy_seed=8)
    lines = map(json.loads, (tmp_path / "run/metrics.jsonl").read_text().splitlines())
    updates = [line for line in lines if line["kind"] == "update"]
    assert [line["steps_per_s"] for line in updates] == [32, 16, 32, 32]


def test_a_run_whose_wandb_folder_is_elsewhere_goes_on_with_its_run(monkeypatch, tmp_path):
    """One that was not logged there begins."""
    monkeypatch.setattr("lerobot.common.wandb_utils.WandBLogger", lambda config: config.resume)
    opened = []
    for run_id in ("abc", None):
        cfg = config(tmp_path)
        cfg.resume, cfg.wandb.run_id = True, run_id
        opened.append(RunLogger._open_wandb(SimpleNamespace(config=cfg)))
    assert opened == [True, False]


def test_another_update_interval_after_such_a_stop_learns_from_every_transition(tmp_path):
    train(config(tmp_path / "run", **budget(4)))
    options = budget(None)
    options["protocol"] = dataclasses.replace(options["protocol"], update_interval=20)
    trainer = make_trainer(resumed(tmp_path / "run", **options))
    lengths = []
    update = trainer.agent.ppo.update
    trainer.agent.ppo.update = lambda buffer: lengths.append(buffer.rows) or update(buffer)
    trainer.train()
    # 4 rows were left at t = 12; the next multiples of 20 are 20 and 40.
    assert lengths == [12, 20]


def test_a_shorter_metrics_file_is_not_filled_up(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"kind": "update"}\n')
    with pytest.raises(ValueError, match=r"metrics\.jsonl has 19 bytes, 50 when the checkpoint was made"):
        MetricsFile(path, 50)
    assert path.read_text() == '{"kind": "update"}\n'
    MetricsFile(path, 19).close()
    assert path.stat().st_size == 19


def test_the_evaluation_that_ends_a_run_is_not_there_once_it_goes_on(tmp_path):
    """Nor does it keep a due one away, or count as that of so many interventions."""
    evaluated = {"eval_freq": 48, "eval_at_interventions": [4]}
    train(config(tmp_path / "whole", **budget(None) | evaluated))
    train(config(tmp_path / "stopped", **budget(4) | evaluated))
    assert [line["interaction_steps"] for line in evaluations(tmp_path / "stopped")] == [0, 48]
    # With nothing left to do it is made again.
    train(resumed(tmp_path / "stopped", **budget(4) | evaluated), policy_seed=8)
    assert [line["interaction_steps"] for line in evaluations(tmp_path / "stopped")] == [0, 48]
    train(resumed(tmp_path / "stopped", **budget(None) | evaluated), policy_seed=8)
    assert_same_run(tmp_path / "whole", tmp_path / "stopped")
    found = [(line["interaction_steps"], line["at_interventions"]) for line in evaluations(tmp_path / "stopped")]
    assert found == [(0, []), (64, [4]), (96, []), (128, [])]


def evaluations(folder):
    return [line for line in metrics(folder) if line["kind"] == "evaluation"]


def test_tensorboard_has_every_point_once_after_a_resume(tmp_path):
    train(config(tmp_path / "run", steps=2 * STEPS_PER_UPDATE, tensorboard=True, eval_freq=0))
    train(resumed(tmp_path / "run", steps=4 * STEPS_PER_UPDATE, tensorboard=True, eval_freq=0))
    events = EventAccumulator(str(tmp_path / "run/tensorboard")).Reload()
    (tag,) = (tag for tag in events.Tags()["scalars"] if tag.endswith("steps_per_s"))
    assert [event.step for event in events.Scalars(tag)] == [n * STEPS_PER_UPDATE for n in (1, 2, 3, 4)]
