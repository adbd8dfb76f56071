"""Reads the flags of an experiment's runs as `cronos-train` will, before the first of them is started."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import draccus
from draccus import cfgparsing
from draccus.utils import DecodingError, ParsingError, deflatten
from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig, load_benchmark

from cronos_lerobot.agents.registry import check_agent, check_reward, check_settings
from cronos_lerobot.experiments.flags import read_flags
from cronos_lerobot.experiments.jobs import Job
from cronos_lerobot.experiments.scales import PIXELS
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.configurations import check_configurations
from cronos_lerobot.training.resume import allow_single_file

BASE_POLICY = "pocketvla"
"""Type of the base policies that experiments make."""
WHICH_RUN = ("seed", "output_dir", "policy.path")
"""Flags whose values cannot be wrong: runs that differ in nothing else are read once."""
PICTURES = ("camera_name", "observation_height", "observation_width", "renderer")
"""Flags of `--env.*` that decide what pictures look like."""


def check_commands(jobs: Iterable[Job], policy_type: str | None = BASE_POLICY) -> None:
    """Refuse flags that `cronos-train` would refuse when a run begins, hours later perhaps.

    Modules that the flags name (`discover_packages_path`) are imported.

    Args:
        jobs: of which those of `cronos-train` are looked at.
        policy_type: of the base policy that is made, for the names of `--policy.*` and what it has seen; None if
            it is one of the user's, of which nothing is known before it is loaded.

    Raises:
        ValueError: a run has a flag that does not exist, or a value that is none; it names the run.
        PluginLoadError: a module cannot be imported.
    """
    register_third_party_plugins()
    seen = set()
    for job in jobs:
        if job.command[0] != "cronos-train":
            continue
        try:
            given = dict(read_flags(job.command[1:]))
            key = tuple(sorted((name, value) for name, value in given.items() if name not in WHICH_RUN))
            if key not in seen:
                seen.add(key)
                _check(given, policy_type)
        except (ValueError, OSError, ParsingError) as error:
            raise ValueError(f"{job.name} would not begin: {_reason(error)}") from error


def _check(given: dict[str, str], policy_type: str | None) -> None:
    for name in list(given):
        if parser.PLUGIN_DISCOVERY_SUFFIX in name:
            module = given.pop(name)
            allow_single_file(module)
            parser.load_plugin(module)
    # A plan is made without the Hub: a benchmark of it is looked for when the run begins.
    benchmark = given.pop("env.benchmark", None)
    # So is the policy's own config, for which the flags are.
    policy = {name.split(".")[1] for name in given if name.startswith("policy.")} - {"path"}
    if policy_type is not None:
        valid = {field.name for field in fields(PreTrainedConfig.get_choice_class(policy_type))}
        if unknown := sorted(policy - valid):
            raise ValueError(f"--policy.{unknown[0]} is no flag of --policy.type={policy_type}")
    if "algorithm.type" in given:
        check_agent(given["algorithm.type"])
    values: dict[str, Any] = {
        name: cfgparsing.parse_string(value) for name, value in given.items() if not name.startswith("policy.")
    }
    config = draccus.decode(CronosTrainConfig, deflatten(values, sep="."))
    config.check_start()
    check_reward(config.algorithm, config.protocol.reward)
    if config.env is not None:
        config.check_env(config.env)
        if benchmark is None:
            check_configurations(config, load_benchmark(None, config.env.scene), str(config.env.scene))
        if policy_type is not None:
            _check_base(config.env)
        # A recording's folder is looked at when its run begins, or goes on.
        if config.record.repo_id is None:
            folder, length = Path(config.output_dir or ""), config.protocol.task_switch_interval
            config.record.check(folder, config.num_envs, config.env, length, resume=False)
    settings = [name.removeprefix("algorithm.") for name in given if name.startswith("algorithm.")]
    check_settings(config.algorithm, settings, resume=False)


def _check_base(env: CronosEnvConfig) -> None:
    """Refuse to show the runs what a base policy that is made, without their flags, has not seen.

    Not `--env.benchmark`: other configurations are what a policy may go on to.
    """
    for name in ("task_observation", *(PICTURES if env.obs_type == PIXELS else ())):
        if (value := getattr(env, name)) != getattr(CronosEnvConfig, name):
            raise ValueError(
                f"--env.{name}={value} is of the runs alone, and their base policy is cloned without it: give "
                "--policy.path, a policy that was cloned with it"
            )


def _reason(error: Exception) -> str:
    """What it says, on one line; draccus hides what a config says of its values in the cause."""
    hidden = isinstance(error, ParsingError) and not isinstance(error, DecodingError)
    return " ".join(str(error.__cause__ or error if hidden else error).split())
