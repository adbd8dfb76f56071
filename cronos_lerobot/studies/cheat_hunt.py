"""A search for ways to be paid success without having carried the object.

    python -m cronos_lerobot.studies.cheat_hunt [--scene=kitchen_2x2] [--trials=1536] [--output=hunt.csv]

For every pair of an object and a receptacle, a hand pushes, presses and drops: the cross-entropy method over where
object and hand begin, two legs and a retreat of the hand, its turn and its fingers. A trial has found something if
a rule pays while the object, up to that moment, was never carried: at no instant was its whole surface more than
1 mm off the table and off all receptacles with the hand touching it. Or, under version 1's rule, if it pays for an
object that does not stay once the hand is gone; objects that are dropped at the rim are there for that.

The table says for each pair how many trials were paid by version 0's rule and by version 1's, in the same trials,
and in how many the object came to LIE on the receptacle without being carried: toppled, rolled or pushed up.
"""

import argparse
import csv
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosVectorEnv, Task, get_scene
from PIL import Image
from tqdm import tqdm

from cronos_lerobot.studies.cheat_trials import (
    KINDS,
    NUM_PARAMETERS,
    RULES,
    Pair,
    Trials,
    WatchedSimulation,
    run_trials,
)

POPULATION, ELITE_SHARE = 128, 1 / 8
"""Trials of a generation, and the share of them that the next one is drawn from."""
MIN_SPREAD = 0.08
"""Standard deviation that the search keeps in every number of a trial."""


@dataclass
class Row:
    """What was found for one pair and kind of trial."""

    pair: str
    """Instruction."""
    kind: str
    """`push`, `press` or `drop`."""
    trials: int
    paid_v0: int
    """Trials that version 0's rule paid without carrying."""
    paid_v1: int
    """Trials that version 1's rule paid without carrying."""
    unsteady_v1: int
    """Trials that version 1's rule paid for an object that did not stay."""
    lay_uncarried: int
    """Trials in which the receptacle alone bore the object, though it was never carried."""
    steps_v0: int
    """Most control steps of one trial that version 0's rule paid."""


@dataclass
class Best:
    """The trial that a rule paid most, or that came closest to it."""

    score: float
    pair: str
    positions: np.ndarray
    """(nq,) MuJoCo's generalised positions at its best moment."""


class Search:
    """The cross-entropy method on one kind of trial of one pair, after what one rule pays."""

    def __init__(self, rule: str, rng: np.random.Generator):
        self.rule, self._rng = rule, rng
        self._near: tuple[np.ndarray, np.ndarray] | None = None

    def draw(self, n: int) -> np.ndarray:
        """The trials (n, NUM_PARAMETERS) of the next generation; half of them anywhere."""
        x = self._rng.random((n, NUM_PARAMETERS))
        if self._near is not None:
            near = self._rng.normal(*self._near, x.shape)
            # The first number is an angle.
            near[:, 0] %= 1.0
            x[n // 2 :] = np.clip(near, 0.0, 1.0)[n // 2 :]
        return x

    def learn(self, x: np.ndarray, trials: Trials) -> None:
        """Draw the next generation near the best of this one."""
        num_elite = max(2, round(ELITE_SHARE * len(x)))
        elite = x[np.argsort(-trials.score[self.rule], kind="stable")[:num_elite]]
        self._near = elite.mean(0), np.maximum(elite.std(0), MIN_SPREAD)


def hunt(
    scene: str,
    num_trials: int,
    rules: tuple[str, ...] = RULES,
    seed: int = 0,
    *,
    kinds: tuple[str, ...] = KINDS,
    population: int = POPULATION,
) -> tuple[list[Row], dict[str, Best]]:
    """Search every pair of a scene with about `num_trials` trials; rows, and the best trial by rule.

    Args:
        scene: name of the scene.
        num_trials: of each pair; rounded up to whole generations for each kind and rule.
        rules: which rule's payment the search is after; each gets its share of the trials.
        seed: of everything that is drawn.
        kinds: of trials.
        population: trials of a generation.
    """
    sim = WatchedSimulation(get_scene(scene), population)
    rng = np.random.default_rng(seed)
    generations = -(-num_trials // (population * len(kinds) * len(rules)))
    tasks = sim.scene.tasks
    pairs = [Pair(o, r) for o in sim.scene.objects for r in sim.scene.receptacles]
    rows, best = [], {rule: Best(-np.inf, "", sim.qpos[0].copy()) for rule in RULES}
    total = len(tasks) * len(kinds) * len(rules) * generations * population
    with tqdm(total=total, unit="trial", disable=None) as bar:
        for task, pair in zip(tasks, pairs, strict=True):
            for kind in kinds:
                row = Row(task.instruction, kind, 0, 0, 0, 0, 0, 0)
                for rule in rules:
                    search = Search(rule, rng)
                    for _ in range(generations):
                        x = search.draw(population)
                        trials = run_trials(sim, pair, kind, x)
                        search.learn(x, trials)
                        _add(row, trials)
                        _keep_best(best, task, kind, trials)
                        bar.update(population)
                rows.append(row)
    return rows, best


def _add(row: Row, trials: Trials) -> None:
    row.trials += len(trials.lay)
    row.paid_v0 += int((trials.paid["v0"] > 0).sum())
    row.paid_v1 += int((trials.paid["v1"] > 0).sum())
    row.unsteady_v1 += int(trials.unsteady.sum())
    row.lay_uncarried += int(trials.lay.sum())
    row.steps_v0 = max(row.steps_v0, int(trials.paid["v0"].max()))


def _keep_best(best: dict[str, Best], task: Task, kind: str, trials: Trials) -> None:
    if kind == "drop":
        return
    for rule in RULES:
        i = int(trials.score[rule].argmax())
        if trials.score[rule][i] > best[rule].score:
            best[rule] = Best(float(trials.score[rule][i]), task.instruction, trials.positions[rule][i].copy())


def print_table(rows: list[Row], rules: tuple[str, ...]) -> None:
    """One line for each pair, its kinds together, and one for all."""
    header = ("pair", "trials", "paid v0", "longest v0", "paid v1", "not staying v1", "lay uncarried")
    print(f"{header[0]:<45}" + "".join(f"{name:>15}" for name in header[1:]))
    pairs = list(dict.fromkeys(row.pair for row in rows))
    for name in (*pairs, "all"):
        mine = [row for row in rows if name in ("all", row.pair)]
        paid_v0 = sum(row.paid_v0 for row in mine)
        cells = [
            sum(row.trials for row in mine),
            paid_v0,
            f"{max(row.steps_v0 for row in mine)} steps",
            sum(row.paid_v1 for row in mine) if "v1" in rules else "-",
            sum(row.unsteady_v1 for row in mine) if "v1" in rules else "-",
            sum(row.lay_uncarried for row in mine),
        ]
        if "v0" not in rules:
            cells[1:3] = ["-", "-"]
        print(f"{name:<45}" + "".join(f"{cell:>15}" for cell in cells))


def write_csv(path: Path, rows: list[Row]) -> None:
    """Write one line for each pair and kind of trial."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def draw_best(path: Path, scene: str, best: Best) -> None:
    """Render the best moment of a trial as a PNG."""
    env = CronosVectorEnv(1, scene, obs_type="environment_state_agent_pos")
    Image.fromarray(env.render_positions(best.positions[None])[0]).save(path)
    env.close()


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="kitchen_2x2")
    parser.add_argument("--trials", type=int, default=1536, help="of each pair")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rule", choices=(*RULES, "both"), default="both", help="what the search is after")
    parser.add_argument("--output", type=Path, help="CSV; pictures of the best trials are written beside it")
    args = parser.parse_args(argv)
    if args.trials < 1:
        parser.error(f"--trials must be at least 1, got {args.trials}")
    register_third_party_plugins()
    try:
        get_scene(args.scene)
    except ValueError as error:
        parser.error(str(error))
    return args


def main() -> None:
    """Hunt, print the table, write what was asked for."""
    args = parse_args()
    rules = RULES if args.rule == "both" else (args.rule,)
    rows, best = hunt(args.scene, args.trials, rules, args.seed)
    print_table(rows, rules)
    if args.output is None:
        return
    write_csv(args.output, rows)
    for rule in rules:
        picture = args.output.with_name(f"{args.output.stem}_{rule}.png")
        draw_best(picture, args.scene, best[rule])
        print(f"{rule}: best score {best[rule].score:.2f}, {best[rule].pair}: {picture}")


if __name__ == "__main__":
    main()
