"""How large an experiment is run, and the base policy that it starts from."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cronos_lerobot.experiments.definitions import LONG, NARROW, SHORT

STATE, PIXELS = "environment_state_agent_pos", "pixels_agent_pos"
OBS_NAMES = {STATE: "state", PIXELS: "pixels"}
"""Kinds of observation (`--env.obs_type`), and what folders call them."""


@dataclass(frozen=True)
class Scale:
    """How much of everything a run gets."""

    name: str
    steps: dict[int, int]
    """S [interaction steps] for each S of the paper."""
    seeds: int
    """Runs of each row."""
    num_envs: int
    """Parallel streams."""
    eval_freq: int
    """Interaction steps between two evaluations, and between two checkpoints."""
    eval_episodes: int
    """Configurations for each task of a periodic evaluation."""
    smoke: bool = False
    """Whether it only shows that everything runs: the smallest base policy, few configurations and orderings."""


SCALES: dict[str, Scale] = {
    "paper": Scale("paper", {SHORT: SHORT, LONG: LONG}, seeds=5, num_envs=64, eval_freq=102_400, eval_episodes=64),
    "small": Scale(
        "small", {SHORT: 307_200, LONG: 614_400}, seeds=3, num_envs=64, eval_freq=51_200, eval_episodes=64
    ),
    "smoke": Scale(
        "smoke",
        # Each its own, as folders of runs are named by their steps.
        {SHORT: 2_560, LONG: 3_840},
        seeds=1,
        num_envs=4,
        eval_freq=1_280,
        eval_episodes=1,
        smoke=True,
    ),
}


DIVERSE_DEMO_FLAGS = ("--noise.share=0.75", "--misses.share=0.25", "--steps_after_release=8")
"""Noise and misses show how to recover, the frames after the release that a finished task is left alone."""
WIDE, WIDE_RESETS = "wide", "wide_resets"
_WIDE_FLAGS = (
    "--start.layouts=reach",
    "--start.arm_pose=after_task",
    "--start.occupied_receptacles=true",
    "--start.misplaced_objects=true",
    "--start.earlier_tasks=3",
    "--start.share=0.5",
)
BASE_KINDS: dict[str, tuple[str, ...]] = {
    NARROW: (),
    WIDE: _WIDE_FLAGS,
    WIDE_RESETS: (*_WIDE_FLAGS, "--reset_tasks=true"),
}
"""Kinds of base policies by where their demonstrations begin, as flags of `cronos-record-demos`: in the training
configurations; wherever the arm can do the tasks, every second after one to three other tasks: where they left the
arm, other objects on the target, the object itself on another receptacle; the same with reset tasks among them."""


@dataclass(frozen=True)
class BaseRecipe:
    """How the base policy is made; PPO learns from one that succeeds in .3 to .6 of the evaluation."""

    demos: int
    """Demonstrations of the scripted expert, all tasks together."""
    clone_steps: int
    """Gradient steps of behaviour cloning."""
    checkpoint: int
    """The step whose policy is the base: a quarter, half, three quarters or all of `clone_steps`."""
    clone_batch: int = 256
    """Frames of a gradient step."""
    clean: bool = False
    """Whether the demonstrations have no noise, no missed grasps and no frames after the release: the arm always
    comes from home, which is the bias of the paper's base policy (Section 5)."""
    kind: str = NARROW
    """Where the demonstrations begin: one of `BASE_KINDS`."""

    def __post_init__(self) -> None:
        valid = [*range(self.save_freq, self.clone_steps, self.save_freq), self.clone_steps]
        if self.checkpoint not in valid:
            raise ValueError(f"base.checkpoint must be one of {valid}, got {self.checkpoint}")

    @property
    def demo_flags(self) -> tuple[str, ...]:
        """Flags of `cronos-record-demos`."""
        return BASE_KINDS[self.kind] + (() if self.clean else DIVERSE_DEMO_FLAGS)

    @property
    def made(self) -> str:
        """What its folder is called after."""
        words = ("" if self.kind == NARROW else self.kind, "clean" if self.clean else "", "demos")
        return f"{self.demos}{''.join(words)}_{self.clone_steps}steps"

    @property
    def save_freq(self) -> int:
        """Steps between two checkpoints of the cloning."""
        return max(1, self.clone_steps // 4)


MODEL = "kitchen_2x2"
"""The scene whose recipes others take, with as much for each of their tasks."""
BASE_RECIPES: dict[tuple[str, str], BaseRecipe] = {
    (MODEL, STATE): BaseRecipe(400, 320, checkpoint=320),
    ("playroom_2x2", STATE): BaseRecipe(400, 640, checkpoint=480),
    (MODEL, PIXELS): BaseRecipe(3200, 1600, checkpoint=1600),
}
"""By scene and kind of observation; scenes that are not here take `MODEL`'s. Measured (docs/experiments.md), with
`kitchen_3x3` from the state. From pixels 800 demonstrations are learned by heart (docs/trials.md); more of them
cost minutes, and no gradient step."""
CLEAN_RECIPES: dict[tuple[str, str], BaseRecipe] = {
    (MODEL, STATE): BaseRecipe(400, 640, checkpoint=480, clean=True),
}
"""The same from clean demonstrations."""
WIDE_RECIPES: dict[tuple[str, str], BaseRecipe] = {
    (MODEL, STATE): BaseRecipe(1200, 1920, checkpoint=1920, kind=WIDE),
    (MODEL, PIXELS): BaseRecipe(3200, 2400, checkpoint=2400, kind=WIDE),
}
"""The same over the whole reach. What may lie anywhere takes more demonstrations: `kitchen_2x2`'s clone of 400
came to .43 and stayed there, of 1,200 to .82 (docs/trials.md); the other scenes have as many for each task."""
WIDE_RESETS_RECIPES: dict[tuple[str, str], BaseRecipe] = {
    (MODEL, STATE): BaseRecipe(3600, 3840, checkpoint=3840, kind=WIDE_RESETS),
    (MODEL, PIXELS): BaseRecipe(3200, 2400, checkpoint=2400, kind=WIDE_RESETS),
}
"""The same with reset tasks, of each as many as of any other task: learned resets have to succeed."""
SMOKE_RECIPE = BaseRecipe(8, 5, checkpoint=5, clone_batch=32)

ALGORITHM_FLAGS = {
    STATE: ("--algorithm.type=ppo",),
    PIXELS: ("--policy.freeze_encoder=true", "--algorithm.type=ppo", "--algorithm.policy_lr=1e-4"),
}
"""Flags of `cronos-train` that learn from each kind of observation; PPO's go where another agent is chosen."""


def base_recipe(scale: Scale, scene: str, obs_type: str, *, clean: bool = False, kind: str = NARROW) -> BaseRecipe:
    """The recipe of a scene's base policy of a kind, the narrow one on request from clean demonstrations.

    A scene without one of its own has that of `MODEL`, by the number of their tasks.

    Raises:
        ValueError: there is no such kind, no such scene, or no recipe; a policy can be given with --policy.path.
    """
    if kind not in BASE_KINDS:
        raise ValueError(f"the base of a row must be one of {list(BASE_KINDS)}, got {kind!r}")
    clean = clean and kind == NARROW
    if scale.smoke:
        return replace(SMOKE_RECIPE, clean=clean, kind=kind)
    recipes = {
        NARROW: CLEAN_RECIPES if clean else BASE_RECIPES,
        WIDE: WIDE_RECIPES,
        WIDE_RESETS: WIDE_RESETS_RECIPES,
    }[kind]
    if (scene, obs_type) in recipes:
        return replace(recipes[scene, obs_type], kind=kind)
    if (MODEL, obs_type) not in recipes:
        known = ", ".join(OBS_NAMES[o] for _, o in recipes)
        name = "clean base policy" if clean else "base policy" if kind == NARROW else f"{kind} base policy"
        raise ValueError(
            f"no recipe for a {name} from {OBS_NAMES[obs_type]}; from {known} there is: use --policy.path"
        )
    return replace(_for_tasks(recipes[MODEL, obs_type], scene), kind=kind)


def _for_tasks(recipe: BaseRecipe, scene: str) -> BaseRecipe:
    """A recipe of `MODEL` with as many demonstrations and gradient steps for each task of another scene."""
    from lerobot.utils.import_utils import register_third_party_plugins
    from lerobot_env_cronos.scene.scenes import SCENES, describe_unknown_scene, get_scene

    if scene not in SCENES:
        # An installed one is registered by the import of its package.
        register_third_party_plugins()
    if scene not in SCENES:
        # Demonstrations and clone are commands that no other module is given to.
        raise ValueError(describe_unknown_scene(scene, None))
    tasks, of = len(get_scene(scene).tasks), len(get_scene(MODEL).tasks)
    steps = recipe.clone_steps * tasks // of
    more = replace(recipe, demos=recipe.demos * tasks // of, clone_steps=steps, checkpoint=steps)
    quarters = 4 * recipe.checkpoint // recipe.clone_steps
    return more if quarters == 4 else replace(more, checkpoint=quarters * more.save_freq)
