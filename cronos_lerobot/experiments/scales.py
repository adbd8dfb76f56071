"""How large an experiment is run, and the base policies that its runs begin with."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cronos_lerobot.experiments.definitions import LONG, ONE, PAPER, SHORT, WIDE

STATE, PIXELS = "environment_state_agent_pos", "pixels_agent_pos"
OBS_TYPES = {"state": STATE, "pixels": PIXELS}
"""Kinds of observation (`--env.obs_type`) by what folders call them."""

UPDATE_INTERVAL = 160
"""U: control steps of each stream between two policy updates (Table 2)."""


@dataclass(frozen=True)
class Scale:
    """How much of everything a run gets."""

    name: str
    steps: dict[int, int]
    """S [interaction steps] for each S of the paper."""
    seeds: int
    """Runs of each row."""
    num_envs: int = 64
    """Parallel streams."""
    eval_freq: int = 102_400
    """Interaction steps between two evaluations, and between two checkpoints."""
    smoke: bool = False
    """Show that everything runs: a base policy that has learned nothing, one episode where there are 64."""

    @property
    def steps_per_update(self) -> int:
        """Interaction steps, all streams together, between two policy updates."""
        return self.num_envs * UPDATE_INTERVAL

    def scaled(self, number: int, paper_steps: int) -> int:
        """A number of steps or interventions of a run with the paper's steps, in a run of this scale."""
        return number * self.steps[paper_steps] // paper_steps

    def checkpoints(self, paper_steps: int) -> list[int]:
        """Interaction steps of the checkpoints of a run; it ends at the last one, with a whole update."""
        last = -(-self.steps[paper_steps] // self.steps_per_update) * self.steps_per_update
        updates = range(self.steps_per_update, last, self.steps_per_update)
        crossed = [n for n in updates if n // self.eval_freq > (n - self.steps_per_update) // self.eval_freq]
        return [*crossed, last]


SCALES = {
    "paper": Scale("paper", {SHORT: SHORT, LONG: LONG}, seeds=5),
    "small": Scale("small", {SHORT: 307_200, LONG: 614_400}, seeds=3, eval_freq=51_200),
    # Each its own number of steps: folders of runs are named by them.
    "smoke": Scale("smoke", {SHORT: 2_560, LONG: 3_840}, seeds=1, num_envs=4, eval_freq=1_280, smoke=True),
}

DIVERSE_FLAGS = ("--noise.share=0.75", "--misses.share=0.25", "--steps_after_release=8")
"""Noise and missed grasps show how to recover; the steps after the release, that a finished task is left alone."""
WIDE_FLAGS = (
    "--start.layouts=reach",
    "--start.arm_pose=after_task",
    "--start.occupied_receptacles=true",
    "--start.misplaced_objects=true",
    "--start.earlier_tasks=3",
    "--start.share=0.5",
)
"""Layouts all over the reach, every second one after one to three other tasks."""
BASE_FLAGS = {PAPER: (), WIDE: WIDE_FLAGS, ONE: ("--start.num_configurations=1",)}


@dataclass(frozen=True)
class BaseRecipe:
    """How a base policy is made. PPO learns from one that succeeds in .3 to .6 of the evaluation."""

    demos: int
    """Demonstrations of the scripted expert, all tasks together."""
    clone_steps: int
    """Gradient steps of behaviour cloning."""
    batch: int = 256
    """Frames of a gradient step."""


NUM_TASKS = {"kitchen_2x2": 4, "kitchen_3x3": 9, "playroom_2x2": 4}
RECIPES = {
    (PAPER, STATE): BaseRecipe(400, 320),
    (ONE, STATE): BaseRecipe(400, 320),
    (WIDE, STATE): BaseRecipe(1200, 640),
    (WIDE, PIXELS): BaseRecipe(2400, 1200, batch=128),
}
"""For the four tasks of `kitchen_2x2`; another scene has as much for each of its tasks."""
PLAYROOM = BaseRecipe(400, 480)
"""`playroom_2x2` with the state takes more steps from the training configurations."""


def base_recipe(scale: Scale, scene: str, obs_type: str, base: str) -> BaseRecipe:
    """The recipe of a scene's base policy."""
    if scale.smoke:
        return BaseRecipe(8, 5, batch=32)
    if (scene, obs_type) == ("playroom_2x2", STATE) and base != WIDE:
        return PLAYROOM
    recipe, tasks = RECIPES[base, obs_type], NUM_TASKS.get(scene, 4)
    return replace(recipe, demos=recipe.demos * tasks // 4, clone_steps=recipe.clone_steps * tasks // 4)
