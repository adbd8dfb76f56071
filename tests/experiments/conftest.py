"""Options of tiny experiments."""

import pytest
from experiment_runs import TINY

from cronos_lerobot.experiments.definitions import EXPERIMENTS
from cronos_lerobot.experiments.scales import STATE, base_recipe
from cronos_lerobot.experiments.specs import Options


@pytest.fixture
def options(tmp_path):
    bases = {row.begins_with(e.scene) for e in EXPERIMENTS.values() for row in e.rows}
    recipes = {base.recipe: base_recipe(TINY, base.scene, STATE, kind=base.kind) for base in bases}
    return Options(TINY, STATE, (1, 2), tmp_path / "root", recipes=recipes)
