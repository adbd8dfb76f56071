"""docs/training.md names every flag of cronos-train, with the default that it has."""

import json
import re
from dataclasses import fields
from pathlib import Path

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.training.config import CronosTrainConfig, PeriodicEvaluationConfig

DOCS = (Path(__file__).parents[2] / "docs/training.md").read_text()
DOCUMENTED = {
    flag.removeprefix("--"): default
    for line in DOCS.splitlines()
    if line.startswith("| `")
    for cells in [line.strip("|").split("|")]
    for flag, default in zip(re.findall(r"`([^`]+)`", cells[0]), [*cells[1].split(","), ""], strict=False)
}


def test_every_flag_has_its_default():
    expected = {f.name: getattr(ProtocolConfig(), f.name) for f in fields(ProtocolConfig)}
    critic = expected.pop("critic")
    expected |= {f"critic.{f.name}": getattr(critic, f.name) for f in fields(critic)}
    evaluation = PeriodicEvaluationConfig()
    expected |= {f"eval.{f.name}": getattr(evaluation, f.name) for f in fields(PeriodicEvaluationConfig)}
    config = CronosTrainConfig()
    simple = (
        "steps",
        "num_envs",
        "seed",
        "save_freq",
        "save_checkpoint",
        "keep_checkpoints",
        "resume",
        "eval_freq",
    )
    expected |= {name: getattr(config, name) for name in (*simple, "log_freq", "tensorboard", "torch_threads")}
    for name, value in expected.items():
        text = value if isinstance(value, str) else json.dumps(value)
        assert DOCUMENTED[name].strip(" `") == text, name


def test_no_flag_is_left_out():
    groups = {"protocol", "eval", "checkpoint_path"}  # the first two have tables of their own; the last is no flag
    names = {field.name for field in fields(CronosTrainConfig)} - groups
    documented = {re.split(r"[.]", flag)[0] for flag in DOCUMENTED}
    assert names <= documented, names - documented
