"""Fills in the cards of `datasets_cards/`."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import draccus
import jinja2
from lerobot.rl.algorithms.configs import RLAlgorithmConfig
from lerobot.utils.utils import flatten_dict
from lerobot_env_cronos import CronosEnvConfig
from markupsafe import Markup

from cronos_lerobot.hub.stage import clean
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.streams import STEPS_PER_TASK
from cronos_lerobot.provenance import package_versions
from cronos_lerobot.training.config import CronosTrainConfig

PACKAGED = Path(__file__).parent / "cards"
CHECKOUT = Path(__file__).parents[2] / "datasets_cards"
SHOWN = ("env.", "protocol.", "algorithm.", "num_envs", "steps", "seed")
"""Flags that a card shows, by their beginning."""


def render_card(kind: str, **values: Any) -> str:
    """The card `kind`.md with `values`.

    Values may come from files of other people. Each stays in its line and cannot end the code that it stands in.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PACKAGED if PACKAGED.is_dir() else CHECKOUT),
        undefined=jinja2.StrictUndefined,
        finalize=one_line,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.policies["json.dumps_kwargs"] = {"ensure_ascii": False}
    environment.filters |= {"code": code, "cell": cell, "command": command, "interval": interval}
    return environment.get_template(f"{kind}.md").render({"versions": package_versions()} | values)


def one_line(value: Any) -> str:
    """A value as text in one line, without backticks; Markdown that is made here stays as it is."""
    return value if isinstance(value, Markup) else re.sub(r"[\x00-\x1f\x7f\x85\u2028\u2029`]+", " ", str(value))


def code(value: Any) -> Markup:
    """Inline code."""
    return Markup(f"`{clean(one_line(value))[:300] or ' '}`")


def cell(value: Any) -> Markup:
    """Inline code in a table."""
    return Markup(str(code(value)).replace("|", "\\|"))


def command(words: Iterable[str]) -> Markup:
    """A command for a shell, one flag a line."""
    name, *flags = words
    return Markup(" \\\n    ".join([name, *(shlex.quote(clean(one_line(flag))) for flag in flags)]))


def interval(rate: float, ci95: Iterable[float], digits: int = 3) -> str:
    """A number with its 95 % interval."""
    low, high = ci95
    return f"{rate:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def is_packaged(scene: str) -> bool:
    """Whether a scene comes with the environments' package; any other takes a module that registers it."""
    return resources.files("lerobot_env_cronos").joinpath(f"data/{scene}.json").is_file()


def describe_source(source: str) -> str:
    """Where a benchmark is from, without the folders of the person who used it."""
    return "a local folder" if Path(source.partition("@")[0]).exists() else clean(source)


def changed_flags(flags: Mapping[str, Any]) -> dict[str, Any]:
    """The flags of `cronos-train` among `SHOWN` that differ from their defaults.

    Args:
        flags: nested as in `train_config.json`, or by name, such as `protocol.scene_reset_interval`.
    """
    flags = flatten_dict(dict(flags), sep=".")
    algorithm, known = flags.get("algorithm.type"), RLAlgorithmConfig.get_known_choices()
    choice = {"algorithm": known[algorithm]()} if isinstance(algorithm, str) and algorithm in known else {}
    K = flags.get("protocol.task_switch_interval", STEPS_PER_TASK)
    config = draccus.encode(CronosTrainConfig(env=CronosEnvConfig(), protocol=ProtocolConfig(K), **choice))
    defaults = flatten_dict(json.loads(json.dumps(config)), sep=".")
    return {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in flags.items()
        if name.startswith(SHOWN) and not name.startswith("env.features") and value != defaults.get(name)
    }
