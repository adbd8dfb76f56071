"""Jobs of experiments as they would be planned."""

from pathlib import Path

from cronos_lerobot.experiments.definitions import EXPERIMENTS, find_rows
from cronos_lerobot.experiments.plan import make_jobs
from cronos_lerobot.experiments.scales import SCALES, STATE, base_recipe
from cronos_lerobot.experiments.specs import Options


def options(scale="paper", obs_type=STATE, root="out", **changes):
    recipes = {e.scene: base_recipe(SCALES[scale], e.scene, obs_type) for e in EXPERIMENTS.values()}
    seeds = tuple(range(1, SCALES[scale].seeds + 1))
    return Options(SCALES[scale], obs_type, seeds, Path(root), recipes=recipes, **changes)


def jobs_of(name, rows=(), **changes):
    experiment = EXPERIMENTS[name]
    return {j.name: j for j in make_jobs([(experiment, find_rows(experiment, list(rows)))], options(**changes))}
