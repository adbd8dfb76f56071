"""docs/experiments.md says what the code does."""

import ast
import json
import re
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from cronos_lerobot.experiments.definitions import EXPERIMENTS, SHORT, Experiment, Row
from cronos_lerobot.experiments.few_resets import PLUGS, TOGETHER
from cronos_lerobot.experiments.scales import (
    BASE_RECIPES,
    CLEAN_RECIPES,
    OBS_NAMES,
    SCALES,
    WIDE_RECIPES,
    WIDE_RESETS_RECIPES,
    base_recipe,
)
from cronos_lerobot.scripts.reproduce import make_parser

DOCS = (Path(__file__).parents[2] / "docs/experiments.md").read_text()


def table_rows(heading):
    """Cells of the rows of the table whose first column is called `heading`."""
    lines = DOCS[DOCS.index(f"| {heading} |") :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("kind", [Row, Experiment])
def test_fields_of_an_experiment_of_ones_own(kind):
    """Those without a default have none here, and simple defaults are what they are."""
    documented = {}
    for names, default, _ in table_rows(f"field of `{kind.__name__}`"):
        documented |= dict.fromkeys(re.findall(r"\w+", names), default)
    assert documented.keys() == {field.name for field in fields(kind)}
    words = {"": MISSING, "SHORT": SHORT, "both": Experiment.axes}
    for field in fields(kind):
        default = documented[field.name]
        assert (words[default] if default in words else ast.literal_eval(default)) == field.default


def test_numbers_of_runs():
    rows = {row[0]: row for row in table_rows("experiment")}
    distinct = {scale: set() for scale in ("paper", "small")}
    for name, experiment in EXPERIMENTS.items():
        million, paper, small = rows[name][2], rows[name][3], rows[name][5]
        assert million == f"{experiment.steps / 1e6:.1f} M"
        for scale, number in (("paper", paper), ("small", small)):
            assert int(number) == len(experiment.rows) * SCALES[scale].seeds
            if experiment.source:
                distinct[scale] |= {(experiment.scene, experiment.steps, row) for row in experiment.rows}
    for scale, column in (("paper", 3), ("small", 5)):
        assert int(rows["all"][column]) == len(distinct[scale]) * SCALES[scale].seeds
    assert list(rows) == [*EXPERIMENTS, "all"]


def test_scales():
    for name, steps, seeds, streams, frequency, n in table_rows("scale"):
        scale = SCALES[name]
        assert (int(seeds), int(streams), int(n.split()[0])) == (scale.seeds, scale.num_envs, scale.eval_episodes)
        assert int(frequency.split()[0].replace(",", "")) == scale.eval_freq
        if name == "small":
            assert [int(s.replace(",", "")) for s in steps.split(" and ")] == list(scale.steps.values())


def test_recipes():
    tables = (BASE_RECIPES, CLEAN_RECIPES, WIDE_RECIPES, WIDE_RESETS_RECIPES)
    unseen = {
        (scene, obs, recipe.clean, recipe.kind) for table in tables for (scene, obs), recipe in table.items()
    }
    kinds = {name: obs for obs, name in OBS_NAMES.items()}
    for line in DOCS[DOCS.index("| | demonstrations") :].split("\n\n")[0].splitlines()[2:]:
        name, *numbers = (cell.strip() for cell in line.strip("|").split("|")[:4])
        scene, obs = re.findall(r"\w+", name)[:2]
        kind = "wide_resets" if "reset tasks" in name else "wide" if "wide" in name else "narrow"
        clean = "--base.clean=true" in name
        recipe = base_recipe(SCALES["small"], scene, kinds[obs], clean=clean, kind=kind)
        assert [int(number) for number in numbers] == [recipe.demos, recipe.clone_steps, recipe.checkpoint]
        unseen.discard((scene, kinds[obs], clean, kind))
    assert not unseen


def test_every_flag_is_there():
    flags = {flag for action in make_parser()._actions for flag in action.option_strings} - {"-h", "--help"}
    documented = set(re.findall(r"`(--[\w.]+)`", DOCS[DOCS.index("## Flags") : DOCS.index("## Where")]))
    assert documented == flags


def test_pages_are_drawn_anew_by_the_commands_beside_the_archives():
    block = DOCS[DOCS.index("  for paper in table1") :].split("```")[0]
    loop, rest = block.split("  done\n")
    papers, command = re.fullmatch(r"  for paper in (.*); do\n(.*)\n", loop, re.DOTALL).groups()
    lines = [command.replace("$paper", name) for name in papers.split()] + rest.replace("\\\n", " ").splitlines()
    commands = [line.split() for line in lines if line.split()[:1] == ["cronos-reproduce"]]
    results = Path(__file__).parents[2] / "docs/results"
    assert [command[1] for command in commands] == [
        "table1",
        *(f"figure{number}" for number in (2, 3, 4, 5, 7, 8, 11, 13, 14)),
        "figure12",
        *["table1"] * 3,
        *["few_resets"] * 4,
        "few_resets_kitchen_3x3",
        "few_resets_playroom_2x2",
        "few_resets_best",
        "few_resets_budgets",
    ]
    for command in commands:
        rows = command[command.index("--rows") + 1 :] if "--rows" in command else names(command[1])
        scale = next(word.removeprefix("--scale=") for word in command if word.startswith("--scale="))
        seen = "pixels" if "--obs_type=pixels" in command else "state"
        base = "_second_base" if "--output_dir=outputs/few_resets_second_base" in command else ""
        page = results / f"{command[1]}{base}_{scale}_{seen}" / f"{command[1]}.json"
        assert rows == [row["row"] for row in json.loads(page.read_text())["rows"]]


def names(experiment):
    return [row.name for row in EXPERIMENTS[experiment].rows]


def test_plugs():
    words = [row[0] for row in table_rows("word in a row's name")]
    assert words == [
        *PLUGS,
        "takeover_memory",
        "critic_staggered",
        "staggered_decay",
        "asked_decay",
        "_".join(TOGETHER),
        "wide",
    ]
