"""Layouts over everything that the arm can do: bodies wherever a hand that points down gets to, at any yaw.

Benchmark configurations begin in a spawn area of 0.20 x 0.30 m. The streams of a policy that learns without scene
resets do not stay there: most of what it meets later lies elsewhere within reach, where no configuration ever put
it. What is reachable follows from the arm's kinematics, the workspace, the camera and the scene's bodies.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from lerobot_env_cronos.benchmark.configurations import Place, sample_configuration
from lerobot_env_cronos.expert.hands import HANDS
from lerobot_env_cronos.scene.scenes import BODIES, Scene

SPACING_M = 0.02
"""Of the places at which the arm is tried [m]."""
HAND_YAWS = np.deg2rad([0.0, 45.0, 90.0, 135.0])
"""Of the closing axis; the hand has to get there with all of them [rad]."""


@dataclass(frozen=True)
class Reach:
    """Where on the table bodies of a scene may lie for the arm to do its tasks."""

    low: np.ndarray
    """(2,) corner of the box that the end effector's target is clamped to [m]."""
    within: np.ndarray
    """(nx, ny) bool: cells of `SPACING_M` from `low` on, of which all four corners are reachable."""

    def contains(self, xy: np.ndarray) -> np.ndarray:
        """Whether places (..., 2) [m] are within reach: (...,) bool."""
        i, j = np.moveaxis(np.floor((np.asarray(xy) - self.low) / SPACING_M).astype(int), -1, 0)
        inside = (i >= 0) & (j >= 0) & (i < self.within.shape[0]) & (j < self.within.shape[1])
        found = np.zeros(np.shape(inside), dtype=bool)
        found[inside] = self.within[i[inside], j[inside]]
        return found

    def draw(self, body: str, rng: np.random.Generator) -> Place:
        """A place (2,) [m] and a yaw [rad], uniform over the reach and the circle, whatever the body."""
        cells = np.argwhere(self.within)
        cell = cells[rng.integers(len(cells))]
        return self.low + (cell + rng.random(2)) * SPACING_M, rng.uniform(0, 2 * np.pi)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (2,) and (2,) of the box around all of it [m]."""
        cells = np.argwhere(self.within)
        return self.low + cells.min(0) * SPACING_M, self.low + (cells.max(0) + 1) * SPACING_M


@cache
def find_reach(scene: Scene) -> Reach:
    """What the arm reaches in a scene, from the table up to where it carries the scene's tallest object.

    A place is within reach if the end effector may go there, the front camera sees it, and the hand gets there
    pointing down: low enough to grasp what lies flat, and high enough to travel with what stands highest.
    """
    arm, hand = scene.robot, HANDS[scene.arm]
    steps = np.round((arm.high - arm.low)[:2] / SPACING_M).astype(int)
    x, y = (arm.low[k] + np.arange(steps[k] + 1) * SPACING_M for k in range(2))
    places = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
    lowest = hand.tip_reach + hand.tip_clearance
    tallest = max(BODIES[name].size[2] for name in scene.objects)
    seen = arm.sees(np.concatenate([places, np.zeros((*places.shape[:2], 1))], -1))
    good = seen & _hand_gets_to(scene, places, lowest)
    good &= _hand_gets_to(scene, places, lowest + hand.hover + tallest)
    return Reach(arm.low[:2].copy(), good[:-1, :-1] & good[1:, :-1] & good[:-1, 1:] & good[1:, 1:])


def _hand_gets_to(scene: Scene, places: np.ndarray, height: float) -> np.ndarray:
    """Whether the end effector gets to `height` [m] over places (nx, ny, 2), pointing down: (nx, ny) bool."""
    flat = places.reshape(-1, 2)
    target = np.concatenate([flat, np.full((len(flat), 1), height)], 1)
    reached = [HANDS[scene.arm].gets_to(target, yaw) for yaw in HAND_YAWS]
    return np.all(reached, axis=0).reshape(places.shape[:2])


def sample_reach_configuration(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """Draw poses (bodies, 7) of all bodies at rest on the table within reach, no two touching.

    Raises:
        ValueError: the bodies do not fit there, or there is no place within reach.
    """
    reach = find_reach(scene)
    if not reach.within.any():
        tallest = max(scene.objects, key=lambda name: BODIES[name].size[2])
        raise ValueError(
            f"nothing is within reach in {scene.name}: there is no place on the table over which the arm can "
            f"carry the {tallest}, {BODIES[tallest].size[2]} m tall"
        )
    return sample_configuration(scene, rng, reach.draw)
