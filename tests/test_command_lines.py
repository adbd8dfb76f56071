"""What the README and the documentation show: command lines, links, and the README's reset strategy."""

import re
import shlex
import sys
from importlib import import_module
from itertools import chain
from pathlib import Path

import lerobot_policy_openvla  # noqa: F401
import lerobot_policy_pocketvla  # noqa: F401
import lerobot_robot_cronos  # noqa: F401
import numpy as np
import pytest
from flags import parse_flags
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_edit_dataset import EditDatasetConfig

from cronos_lerobot import LoopState
from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.protocol import ProtocolConfig
from cronos_lerobot.scripts import publish, streams
from cronos_lerobot.scripts.record_demos import RecordDemosConfig
from cronos_lerobot.training.config import CronosTrainConfig

ROOT = Path(__file__).parents[1]
CONFIGS = {
    "cronos-train": CronosTrainConfig,
    "cronos-eval": CronosEvalConfig,
    "cronos-record-demos": RecordDemosConfig,
    "lerobot-train": TrainPipelineConfig,
    "lerobot-eval": EvalPipelineConfig,
    "lerobot-edit-dataset": EditDatasetConfig,
    **{f"cronos-publish {name}": config for name, (config, _) in publish.COMMANDS.items()},
    **{f"cronos-streams {name}": config for name, (config, _) in streams.COMMANDS.items()},
}
TYPES = {"--algorithm": "ppo", "--env": "cronos"}
"""What the commands take where none is given."""
PACKAGE = ".discover_packages_path="
PAGES = {page.name: page for page in (ROOT / "README.md", *sorted(ROOT.glob("docs/*.md")))}


def command_lines(text):
    """Line, config class and flags of each command in a page's blocks of code; `<>` is what a reader fills in."""
    for block in re.findall(r"^ *```\w*\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL):
        # Brackets are around what may be left out.
        for line in re.sub(r"\[(--[^\]]*)\]", r"\1", block.replace("\\\n", " ")).splitlines():
            name = next((name for name in CONFIGS if re.match(rf"\s*(\$ )?{name}(?= -)", line)), None)
            if name is not None:
                words = shlex.split(re.sub(r"<[^>]*>|\$\w+|=\.\.\.(?= )", "<>", line), comments=True)
                yield line, CONFIGS[name], [word for word in words if word.startswith("--")]


def readable(flags):
    """The flags but for those of which the line does not say all.

    Which flags a policy at a path has, its files say; a config file, a benchmark, its repository and a package are
    somebody's own.
    """
    groups = [flag.split(".")[0] for flag in flags if re.match(r"--\w+\.path=", flag)]
    elsewhere = ["--config_path=", "--env.benchmark=", "--env.hub_path=", "--env.type=cronos_hub"]
    elsewhere += [f"{group}." for group in groups]
    if any(flag.startswith("--config_path=") for flag in flags):
        elsewhere.append("--env.")
    if any(PACKAGE in flag for flag in flags):
        elsewhere.append("--env.scene=")
    said = [flag for flag in flags if "<>" not in flag and PACKAGE not in flag]
    said = [flag for flag in said if not flag.startswith(tuple(elsewhere))]
    given = {flag.split(".")[0] for flag in said} - {flag.split(".type=")[0] for flag in said if ".type=" in flag}
    return [*said, *(f"{group}.type={name}" for group, name in TYPES.items() if group in given)]


@pytest.mark.parametrize("page", PAGES)
def test_command_lines_are_read(page, monkeypatch):
    for folder in ("examples", "examples/lerobot_policy_mine"):
        monkeypatch.syspath_prepend(ROOT / folder)
    # LeRobot's configs look at it.
    monkeypatch.setattr(sys, "argv", ["command"])
    for plugin in ("lerobot_policy_mine", "rewarded"):
        import_module(plugin)
    for line, config_class, flags in command_lines(PAGES[page].read_text()):
        try:
            parse_flags(config_class, readable(flags))
        except (Exception, SystemExit) as error:
            pytest.fail(f"{page}: {line}\n{error.__cause__ or error}")


def test_there_are_command_lines():
    """Of every command, and flags that are not there are found."""
    shown = [found for page in PAGES.values() for found in command_lines(page.read_text())]
    assert {config_class for _, config_class, _ in shown} == set(CONFIGS.values())
    assert sum(len(readable(flags)) for _, _, flags in shown) > 300
    with pytest.raises(SystemExit):
        parse_flags(CronosTrainConfig, readable(["--policy.path=<>", "--protocol.scene_resets=1"]))


LINKED = ("*.md", "docs/*.md", "docs/results/**/*.md", "envs/**/README.md", "policies/**/README.md")
"""Not the templates of cards, whose links are of the repositories that they are for."""


def prose(page: Path) -> str:
    return re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Those that GitHub gives the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in plain}


def test_links_lead_somewhere():
    broken, seen = [], 0
    for page in chain(*(ROOT.glob(pattern) for pattern in LINKED)):
        for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
            path, _, anchor = link.partition("#")
            if "://" in link:
                continue
            seen += 1
            target = page.parent / path if path else page
            if not target.exists() or (anchor and anchor not in anchors(target)):
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert seen > 50
    assert not broken


def test_the_reset_strategy_resets_after_four_failures_in_a_row():
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names = {}
    exec(code, names)
    strategy = names["AfterFailures"](np.random.default_rng(0), ProtocolConfig())
    loop = LoopState(num_streams=4, num_tasks=4)
    loop.recent_success[:, -5:] = [[1, 0, 0, 0, 0], [0, 0, 0, 0, 1], [-1, -1, 0, 0, 0], [0, 0, 0, 0, 0]]
    # The last one was reset two segments ago: its older failures were in another scene.
    loop.segments_since_reset[:] = [5, 5, 3, 2]
    assert strategy.due(None, loop).tolist() == [0]
