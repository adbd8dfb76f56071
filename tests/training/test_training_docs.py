"""docs/training.md has a table for each group of cronos-train's flags, with every flag and the default it has.

Those of `--record.*` are in docs/streams.md. PPO's has a column of defaults for each of its two names.
"""

import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
import yaml

from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.agents.ppo.config import PaperPPOConfig, PPOConfig, SelfImitationConfig
from cronos_lerobot.agents.steering.config import SteeringConfig
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.training.config import CronosTrainConfig, PeriodicEvaluationConfig
from cronos_lerobot.training.record_config import RecordConfig

DOCS = Path(__file__).parents[2] / "docs"
HEAD = re.compile(r"\| flag \|(?P<defaults>.+)\| meaning \|")
TABLES = {
    ("training", "The protocol", 0): ("", ProtocolConfig()),
    ("training", "The run", 0): ("--", CronosTrainConfig()),
    ("training", "The run", 1): ("--eval.", PeriodicEvaluationConfig()),
    ("training", "PPO", 0): ("--algorithm.", PPOConfig(), PaperPPOConfig()),
    ("training", "Successes that are kept", 0): ("--algorithm.self_imitation.", SelfImitationConfig()),
    ("training", "Imitation", 0): ("--algorithm.", ImitationConfig()),
    ("training", "Steering", 0): ("--algorithm.", SteeringConfig()),
    ("streams", "Record", 0): ("--record.", RecordConfig()),
}
"""By file, heading and number: what is before the names in the table, and the settings of each column."""
ELSEWHERE = {"protocol", "eval", "policy", "checkpoint_path"}
"""Of the run: tables of their own, what is given by its path or type, and what is no flag."""


def tables(page):
    """The rows (flags, then defaults by column) of the tables of flags, by heading and number under it."""
    found, heading, rows, columns = {}, "", None, 0
    for line in (DOCS / f"{page}.md").read_text().splitlines():
        if line.startswith("#"):
            heading = line.strip("# ")
        elif head := HEAD.fullmatch(line):
            columns = len(head["defaults"].split("|"))
            number = sum(place[0] == heading for place in found)
            rows = found[heading, number] = []
        elif not line.startswith("|"):
            rows = None
        elif rows is not None and not line.startswith("|---"):
            flags, *cells = line.strip("|").split("|")
            defaults = [[one.strip(" `") for one in cell.split(", ")] for cell in cells[:columns]]
            rows.append((re.findall(r"`([^`]+)`", flags), *defaults))
    return found


def leaves(settings):
    """Every setting, those of groups by dotted name."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from ((f"{field.name}.{name}", one) for name, one in leaves(value))
        else:
            yield field.name, value


def says(text, value):
    """Whether a cell of the column of defaults is this one; what holds in place of null has a <name> in it."""
    if "<" in text:
        return value is None
    # YAML takes 3e-4 for a word.
    said = float(text) if re.fullmatch(r"\d+e-\d+", text) else yaml.safe_load(text)
    return str(value) == text or (said == value and isinstance(said, bool) == isinstance(value, bool))


@pytest.mark.parametrize("place", TABLES, ids=lambda place: f"{place[1]}, {place[2]}")
def test_every_flag_is_there_with_its_default(place):
    prefix, *columns = TABLES[place]
    for number, settings in enumerate(columns, 1):
        rows = [(row[0], row[number]) for row in tables(place[0])[place[1:]]]
        check_column(rows, settings, prefix)


def check_column(rows, settings, prefix):
    """Every setting has a row, with the default that it has."""
    values, told = dict(leaves(settings)), []
    for flags, defaults in rows:
        assert all(flag.startswith(prefix) for flag in flags), flags
        names = [flag.removeprefix(prefix) for flag in flags]
        told += names
        # All flags of a row may have the same.
        for name, text in zip(names, defaults if len(defaults) > 1 else defaults * len(names), strict=True):
            assert name.split(".")[0] in {field.name for field in fields(settings)}, name
            if name in values:
                assert says(text, values[name]), f"{name}: {text}, but it is {values[name]}"
    assert len(told) == len(set(told))
    groups = {name.removesuffix(".*") for name in told if name.endswith(".*")} | ELSEWHERE
    missing = [name for name in values if name not in told and name.split(".")[0] not in groups]
    assert not missing
