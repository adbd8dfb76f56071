"""The runs in docs/results/runs count as done wherever they are unpacked."""

import tarfile
from pathlib import Path

import pytest

from cronos_lerobot.experiments.definitions import EXPERIMENTS
from cronos_lerobot.experiments.jobs import is_done
from cronos_lerobot.experiments.plan import make_jobs
from cronos_lerobot.experiments.scales import OBS_NAMES, SCALES, base_recipe
from cronos_lerobot.experiments.specs import Options

RESULTS = Path(__file__).parents[2] / "docs/results"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Not the one that the commands of the archived runs name."""
    folder = tmp_path_factory.mktemp("elsewhere")
    for archive in sorted((RESULTS / "runs").glob("*.tar.xz")):
        with tarfile.open(archive) as runs:
            runs.extractall(folder, filter="data")
    return folder


@pytest.fixture(autouse=True)
def in_any_version(monkeypatch):
    """The archives stay as they are where packages get newer."""
    monkeypatch.setattr("cronos_lerobot.experiments.jobs.changed_versions", lambda job: [])


def make_options(root, scale, obs_type, seeds, bases, **more):
    recipes = {base.recipe: base_recipe(SCALES[scale], base.scene, obs_type, kind=base.kind) for base in bases}
    return Options(SCALES[scale], obs_type, tuple(seeds), root, recipes=recipes, **more)


def bases_of(experiment, rows):
    return {row.begins_with(experiment.scene) for row in rows}


def jobs_by_output(root, scale, seeds):
    chosen = [(one, one.rows) for one in EXPERIMENTS.values()]
    state = next(name for name, short in OBS_NAMES.items() if short == "state")
    bases = {base for one, rows in chosen for base in bases_of(one, rows)}
    return {job.output: job for job in make_jobs(chosen, make_options(root, scale, state, seeds, bases))}


def test_archived_runs_are_done_below_any_root(root, monkeypatch):
    outputs = [note.with_name(note.name.removesuffix(".job.json")) for note in sorted(root.rglob("*.job.json"))]
    seeds = sorted({int(part[4:]) for output in outputs for part in output.parts if part.startswith("seed")})
    made = {key: job for scale in ("paper", "small") for key, job in jobs_by_output(root, scale, seeds).items()}
    assert len(outputs) > 50
    assert [output for output in outputs if output not in made or not is_done(made[output])] == []
    # The same root by another name.
    monkeypatch.chdir(root.parent)
    made = jobs_by_output(Path(root.name), "small", seeds[:1])
    there = [output for output in made if (root.parent / output) in outputs]
    assert len(there) >= 7
    assert all(is_done(made[output]) for output in there)
