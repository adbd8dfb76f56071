"""Videos of chains that went well and of some that did not, drawn from what happened."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.envs.utils import parse_camera_names
from lerobot_env_cronos import CronosEnvConfig, get_scene
from lerobot_env_cronos.scene.model import build_model
from lerobot_env_cronos.simulation.rendering import BatchRenderer, make_renderer
from tqdm import tqdm

from cronos_lerobot.evaluation.chains import Chain, Trajectory
from cronos_lerobot.evaluation.plan import Part
from cronos_lerobot.evaluation.store import RESULTS, ResultStore, chain_key, write_json
from cronos_lerobot.film.encode import write_mp4
from cronos_lerobot.film.overlay import Status, draw_status

DRAWN = "videos/drawn.json"
"""In an evaluation's folder: with what each video was drawn, by its name."""
LOOKS = ("renderer", "render_size")
"""Fields of `env` that change the videos, and of a policy that sees the state nothing else."""
GOOD, BAD = "good", "bad"
FPS = 20
"""Four times as fast as it happened."""
LAST_FRAMES = 30
"""For how long the outcome stays on the screen [frames]."""

Render = Callable[[np.ndarray], np.ndarray]
"""Frames (k, H, W, 3) uint8 of joint positions (k, nq)."""


def choose(records: Sequence[dict[str, Any]], num_tasks: int, count: int) -> dict[str, list[dict[str, Any]]]:
    """Choose the chains to film: the longest and the shortest, of those the first configurations.

    Args:
        records: see `store.chain_records`.
        num_tasks: of every chain.
        count: how many of each kind, at most.

    Returns:
        `good`: chains of at least one task, longest first; `bad`: chains that failed, shortest first, none of them
        a `good` one.
    """

    def rank(record: dict[str, Any], sign: int) -> tuple[int, int, int]:
        return sign * record["length"], record["configuration"], record["number"]

    good = sorted((r for r in records if r["length"] > 0), key=lambda r: rank(r, -1))[:count]
    failed = [r for r in records if r["length"] < num_tasks and r not in good]
    return {GOOD: good, BAD: sorted(failed, key=lambda r: rank(r, 1))[:count]}


def film_best_and_worst(
    store: ResultStore, parts: Sequence[Part], env_config: CronosEnvConfig, count: int
) -> list[dict[str, Any]]:
    """Film `count` good and bad chains of every suite and split, unless videos that look so are there already.

    Returns:
        What was filmed: `path` in the store's folder, `suite`, `split`, `kind`, and the chain's record.
    """
    todo = list(_chosen(store, parts, count))
    drawn, looks = note_drawings(store.folder, env_config), _looks(env_config)
    renderer: BatchRenderer | None = None
    videos = []
    for part, kind, record in tqdm(todo, unit="video", disable=None):
        trajectory = store.read_trajectory(part.name, chain_key(record))
        if trajectory is None:
            continue
        what = "task" if part.suite == "independent" else "ordering"
        name = f"{what}{record['number']}_configuration{record['configuration']}"
        path = Path("videos") / f"{part.suite}_{part.split}_{kind}_{name}.mp4"
        videos.append({"path": str(path), "suite": part.suite, "split": part.split, "kind": kind} | record)
        if (store.folder / path).is_file() and drawn[path.name] == looks:
            continue
        try:
            renderer = renderer or _open_renderer(env_config)
        except RuntimeError as error:
            logging.warning("no videos: %s", error)
            return []
        # In this order, so that after a kill no video is there that looks otherwise than noted.
        (store.folder / path).unlink(missing_ok=True)
        drawn[path.name] = looks
        write_json(store.folder / DRAWN, drawn)
        chain = next(c for c in part.chains if chain_key(vars(c)) == chain_key(record))
        where = f"{part.split.replace('_', '-')} {record['configuration']}, {what} {record['number']}"
        film_chain(store.folder / path, chain, record["length"], trajectory, renderer.render, where)
    if renderer is not None:
        renderer.close()
    return videos


def note_drawings(folder: Path, env_config: CronosEnvConfig) -> dict[str, dict[str, Any]]:
    """Note with what the videos in an evaluation's folder were drawn, where it is not noted; returns all notes.

    Those without a note look as results.json says, so this comes before it is written anew.
    """
    path, results = folder / DRAWN, folder / RESULTS
    notes = json.loads(path.read_text()) if path.is_file() else {}
    unnoted = {video.name for video in folder.glob("videos/*.mp4")} - set(notes)
    if unnoted:
        there = json.loads(results.read_text()) if results.is_file() else {}
        env = there.get("config", {}).get("env", {})
        looks = _looks(env_config) | {name: env[name] for name in LOOKS if name in env}
        notes |= dict.fromkeys(sorted(unnoted), looks)
        write_json(path, notes)
    return notes


def _looks(env_config: CronosEnvConfig) -> dict[str, Any]:
    return {"renderer": env_config.renderer, "render_size": list(env_config.render_size)}


def _chosen(store: ResultStore, parts: Sequence[Part], count: int) -> Iterator[tuple[Part, str, dict[str, Any]]]:
    """For every suite and split, the chains to film and the parts that they are in."""
    for suite, split in dict.fromkeys((part.suite, part.split) for part in parts):
        records = []
        for part in parts:
            if (part.suite, part.split) == (suite, split):
                content = store.read(part.name)
                assert content is not None
                records += [(part, record) for record in content["chains"]]
        num_tasks = len(records[0][0].chains[0].tasks)
        for kind, some in choose([record for _, record in records], num_tasks, count).items():
            for record in some:
                yield next(part for part, other in records if other is record), kind, record


def _open_renderer(env_config: CronosEnvConfig) -> BatchRenderer:
    camera = parse_camera_names(env_config.camera_name)[0]
    model = build_model(get_scene(env_config.scene))
    return make_renderer(env_config.renderer, model, *env_config.render_size, camera)


def film_chain(path: Path, chain: Chain, length: int, trajectory: Trajectory, render: Render, where: str) -> None:
    """Write the MP4 of a chain, with its tasks and outcomes on it.

    Args:
        path: of the file.
        chain: what was to be done.
        length: how many of its tasks were.
        trajectory: what happened.
        render: draws joint positions.
        where: says what the chain is of, for the line at the bottom.
    """
    statuses = list(_statuses(chain, length, trajectory, where))
    frames: list[np.ndarray] = []
    # Some at a time: all frames of a long chain without their overlay would double the memory.
    for start in range(0, len(statuses), 64):
        some = slice(start, start + 64)
        drawn = render(trajectory.qpos[some].astype(np.float64))
        frames += [draw_status(frame, status) for frame, status in zip(drawn, statuses[some], strict=True)]
    write_mp4(path, frames + frames[-1:] * LAST_FRAMES, FPS)


def _statuses(chain: Chain, length: int, trajectory: Trajectory, where: str) -> Iterator[Status]:
    num_tasks, last = len(chain.tasks), len(trajectory.qpos) - 1
    for t in range(last + 1):
        position = int(trajectory.position[t])
        status = Status(
            chain.tasks[position].instruction,
            position,
            num_tasks,
            succeeded=bool(trajectory.is_complete[t]),
            interventions=0,
            outcomes=[True] * position,
            caption=f"{where}   task {position + 1}/{num_tasks}   step {t}",
        )
        if t == last:
            done = length == num_tasks
            status.message = f"{'complete' if done else 'failed'}: {length} of {num_tasks} tasks"
            status.outcomes = [True] * length + [False] * (not done)
        yield status
