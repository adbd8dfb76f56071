"""`--help` and wrong flags, answered from the sources of the configs."""

import dataclasses
import subprocess
import sys
from importlib import import_module

import pytest
from draccus.argparsing import ArgumentParser
from lerobot.utils.import_utils import register_third_party_plugins

from cronos_lerobot.scripts.entry import CONFIGS
from cronos_lerobot.scripts.flags import check_flags, find_class, find_commands, read_flags

SUBCOMMANDS = ("publish", "streams")


def parsers_flags(config_class):
    """The flags that draccus takes."""
    actions = ArgumentParser(config_class).parser._actions
    return {option.removeprefix("--") for action in actions for option in action.option_strings}


def config_and_source():
    for command, (module, name) in CONFIGS.items():
        yield command, getattr(import_module(module), name), find_class(module, name)
    for command in SUBCOMMANDS:
        module = f"cronos_lerobot.scripts.{command}"
        sources = find_commands(module)
        for name, (config_class, _) in import_module(module).COMMANDS.items():
            yield f"{command} {name}", config_class, sources[name]


@pytest.mark.parametrize(
    ("config_class", "source"), [pytest.param(*rest, id=one) for one, *rest in config_and_source()]
)
def test_the_sources_have_every_flag_of_the_parser(config_class, source):
    register_third_party_plugins()
    expected = parsers_flags(config_class) - {"help", "h", "-h", "config_path"}
    types = ("--env.type=cronos", "--algorithm.type=ppo", "--policy.type=act")
    found = {flag.name for flag in read_flags(source, types)}
    # draccus has the flags of all types of a choice at once.
    assert found <= expected | {"policy.path"}
    missing = {flag for flag in expected - found if not flag.startswith(("env.", "policy.", "algorithm."))}
    # It names configs in configs by their last word.
    own = {field.name for field in dataclasses.fields(config_class)}
    assert not {flag for flag in missing if "." in flag or flag in own}


TRAIN = find_class(*CONFIGS["train"])


@pytest.mark.parametrize(
    ("flags", "wrong"),
    [
        (["--steps=3", "--env.scene", "kitchen_2x2", "--algorithm.clip=0.1", "--config_path=run.json"], None),
        (["--stepps=3"], "--stepps"),
        (["--protocol.scene_resets=1"], "--protocol.scene_resets"),
        (["--algorithm.type=imitation", "--algorithm.clip=0.1"], "--algorithm.clip"),
        (["--policy.type=act", "--policy.chunk_size=8"], None),
        (["--policy.type=act", "--policy.chunks=8"], "--policy.chunks"),
        (["--policy.path=me/policy", "--policy.whatever=8"], None),
        (["--policy.type=my_own", "--policy.whatever=8"], None),
        (["--steps", "null"], "--steps"),
        (["--save_checkpoint=null"], "--save_checkpoint"),
        (["--algorithm.value_coef=null"], "--algorithm.value_coef"),
        (["--record.repo_id=null", "--protocol.scene_reset_interval=null"], None),
        (["--discover_packages_path=mine", "--algorithm.type=my_own", "--algorithm.whatever=8"], None),
    ],
)
def test_a_flag_that_does_not_exist_is_named(flags, wrong):
    found = check_flags(read_flags(TRAIN, flags), flags)
    assert (found is None) == (wrong is None)
    assert wrong is None or wrong in found


def test_help_has_types_defaults_and_texts():
    flags = {flag.name: flag for flag in read_flags(TRAIN, [])}
    steps = flags["steps"]
    assert (steps.kind, steps.default) == ("int", "1300000")
    assert "interaction steps" in steps.text
    assert flags["eval.split"].default == "'train'"
    assert "act|" in flags["policy.type"].kind
    # LeRobot documents its own in comments.
    assert flags["wandb.disable_artifact"].text


LATE = """
import sys
from cronos_lerobot.scripts import entry
sys.argv = ["command", *sys.argv[2:]]
try:
    getattr(entry, "{command}")()
finally:
    assert not {{"torch", "lerobot", "mujoco", "numpy"}} & set(sys.modules)
"""


@pytest.mark.parametrize(
    ("command", "arguments", "status"),
    [
        ("train", ["--help"], 0),
        ("train", ["--stepps=3"], 2),
        ("evaluate", ["--help"], 0),
        ("record_demos", ["--help"], 0),
        ("streams", ["filter", "--help"], 0),
        ("publish", ["--help"], 0),
        ("publish", ["nothing"], 1),
    ],
)
def test_nothing_large_is_imported_for_an_answer(command, arguments, status):
    code = LATE.format(command=command)
    done = subprocess.run([sys.executable, "-c", code, "command", *arguments], capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    assert "Traceback" not in done.stderr
    assert (done.stdout if status == 0 else done.stderr).strip()
