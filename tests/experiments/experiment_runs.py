"""Runs of made-up success where `cronos-reproduce` would look for them."""

import csv
import json
from dataclasses import replace

from synthetic_runs import INSTRUCTIONS, write_training_run

from cronos_lerobot.experiments.definitions import EXPERIMENTS, LONG, SHORT
from cronos_lerobot.experiments.jobs import made_by, write_record
from cronos_lerobot.experiments.plan import train_job
from cronos_lerobot.experiments.results import collect
from cronos_lerobot.experiments.scales import SCALES
from cronos_lerobot.experiments.specs import run_specs

TINY = replace(SCALES["small"], steps={SHORT: 10_240, LONG: 10_240}, num_envs=8, eval_freq=5_120)
RESETS = {80: 128, 320: 32, 1280: 8}
"""Scene resets of 8 streams in 1280 steps each."""


def make_run(options, name, row, seed, successes, status="done", updates=8):
    """A run whose evaluations had so many successes of 8, of each task; without T it is reset as with 1280."""
    specs = run_specs(EXPERIMENTS[name], options)
    (spec,) = [s for s in specs if (s.row.name, s.seed) == (row, seed)]
    interval = spec.row.interval or 1280
    write_training_run(spec.train_folder, seed=seed, interval=interval, successes=successes, updates=updates)
    job = train_job(spec, None)
    record = {"command": list(job.command), "status": status, "seconds": 1800.0, "starts": 1}
    write_record(job, record | {"made_by": made_by(job)})
    return spec


def results(options, name):
    return collect(EXPERIMENTS[name], EXPERIMENTS[name].rows, options)


def by_row(rows):
    return {row["row"]: row for row in rows}


def read_csv(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def evaluation(success, n=8):
    rate = {"success": success, "n": n, "ci95": [0.0, 1.0]}
    return rate | {"per_task": dict.fromkeys(INSTRUCTIONS, rate)}


RESULTS_HEAD = {"format": 2, "benchmark": {"environment": "lerobot_env_cronos/kitchen_2x2-v1"}}


def write_results(folder, suite, split, content):
    folder.mkdir(parents=True)
    (folder / "results.json").write_text(json.dumps(RESULTS_HEAD | {suite: {split: content}}))
