"""The runs in docs/results/runs count as done wherever they are unpacked, and the pages beside them are theirs."""

import json
import tarfile
from contextlib import suppress
from pathlib import Path

import pytest
from experiment_runs import read_csv

from cronos_lerobot.experiments.definitions import EXPERIMENTS, find_rows
from cronos_lerobot.experiments.jobs import is_done
from cronos_lerobot.experiments.plan import make_jobs
from cronos_lerobot.experiments.results import collect
from cronos_lerobot.experiments.scales import OBS_NAMES, SCALES, base_recipe
from cronos_lerobot.experiments.specs import Options
from cronos_lerobot.experiments.tables import main_rows
from cronos_lerobot.report.tables import write_csv

RESULTS = Path(__file__).parents[2] / "docs/results"
SECOND_BASE = "second_base"
"""A root of its own: the same rows and seeds as in the first, from another base policy."""


@pytest.fixture(scope="module")
def roots(tmp_path_factory):
    """By the names that pages have for them; not those that the commands of the archived runs name."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    folders = {"reproduce": RESULTS / "runs", SECOND_BASE: RESULTS / "runs" / SECOND_BASE}
    for name, archives in folders.items():
        for archive in sorted(archives.glob("*.tar.xz")):
            with tarfile.open(archive) as runs:
                runs.extractall(elsewhere / name, filter="data")
    return {name: elsewhere / name for name in folders}


@pytest.fixture(params=["reproduce", SECOND_BASE])
def root(roots, request):
    return roots[request.param]


@pytest.fixture(autouse=True)
def in_any_version(monkeypatch):
    """The archives stay as they are where packages get newer."""
    monkeypatch.setattr("cronos_lerobot.experiments.jobs.changed_versions", lambda job: [])


def make_options(root, scale, obs_type, seeds, bases, **more):
    recipes = {base.recipe: base_recipe(SCALES[scale], base.scene, obs_type, kind=base.kind) for base in bases}
    return Options(SCALES[scale], obs_type, tuple(seeds), root, recipes=recipes, **more)


def bases_of(experiment, rows):
    return {row.begins_with(experiment.scene) for row in rows}


def jobs_by_output(root, scale, seeds, seen="state", names=tuple(EXPERIMENTS)):
    chosen = [(EXPERIMENTS[name], EXPERIMENTS[name].rows) for name in names]
    obs_type = next(name for name, short in OBS_NAMES.items() if short == seen)
    bases = {base for one, rows in chosen for base in bases_of(one, rows)}
    return {job.output: job for job in make_jobs(chosen, make_options(root, scale, obs_type, seeds, bases))}


def test_archived_runs_are_done_below_any_root(root, monkeypatch):
    outputs = [note.with_name(note.name.removesuffix(".job.json")) for note in sorted(root.rglob("*.job.json"))]
    seeds = sorted({int(part[4:]) for output in outputs for part in output.parts if part.startswith("seed")})
    made = jobs_by_output(root, "paper", seeds) | jobs_by_output(root, "small", seeds)
    for scale in ("paper", "small"):
        made |= jobs_by_output(root, scale, seeds, "pixels", ["table1", "few_resets"])
    assert len(outputs) > (20 if root.name == SECOND_BASE else 50)
    assert [output for output in outputs if output not in made or not is_done(made[output])] == []
    # The same root by another name.
    monkeypatch.chdir(root.parent)
    made = jobs_by_output(Path(root.name), "small", seeds[:1])
    there = [output for output in made if (root.parent / output) in outputs]
    assert len(there) >= 7
    assert all(is_done(made[output]) for output in there)


def test_the_pages_have_the_numbers_of_these_runs(roots, tmp_path):
    checked = []
    for path in sorted(RESULTS.glob("*/*.json")):
        told = json.loads(path.read_text())
        if "orders" not in told:
            # Of version 0.
            continue
        root = roots[Path(told["runs"][0]["metrics"]).parts[1]]
        if not any(is_unpacked(root, run) for run in told["runs"]):
            # Its runs are not kept.
            continue
        experiment = EXPERIMENTS[told["experiment"]]
        rows = find_rows(experiment, [row["row"] for row in told["rows"]])
        bases = bases_of(experiment, rows)
        more = {"temperature": told["temperature"], "extra": tuple(told["extra_flags"])}
        options = make_options(root, told["scale"], told["obs_type"], told["seeds"], bases, **more)
        result = collect(experiment, rows, options)
        assert (path.name, result.changed) == (path.name, [])
        found = main_rows(result)
        # A last digit may be another machine's.
        assert told["rows"] == [pytest.approx(row) for row in found], path
        write_csv(tmp_path / path.name, found)
        lines = [as_numbers(row) for row in read_csv(path.with_suffix(".csv"))]
        assert lines == [pytest.approx(as_numbers(row)) for row in read_csv(tmp_path / path.name)], path
        checked.append(path.parent.name)
    assert {"few_resets_best_paper_state", "table1_small_state", "figure12_small_state"} <= set(checked)


def is_unpacked(root, run):
    return (root / "runs" / run["run"] / "train").is_dir()


def as_numbers(row):
    """A line of a CSV file with its numbers as such."""
    found = {}
    for name, text in row.items():
        with suppress(ValueError):
            text = float(text)
        found[name] = text
    return found
