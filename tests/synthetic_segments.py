"""Segments with pictures that a codec keeps: a square moving over a smooth background."""

from types import SimpleNamespace

import gymnasium
import numpy as np

from cronos_lerobot.data.schema import demonstration_features

FPS = 5
SIZE = 64
STATE_DIM = 5


def observation_space(environment_state: int | None = 3) -> gymnasium.spaces.Dict:
    pixels = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
    spaces = {
        "pixels": gymnasium.spaces.Dict({"front": pixels}),
        "agent_pos": gymnasium.spaces.Box(-1, 1, (STATE_DIM,), np.float32),
    }
    if environment_state:
        spaces["environment_state"] = gymnasium.spaces.Box(-1, 1, (environment_state,), np.float32)
    return gymnasium.spaces.Dict(spaces)


def world(space: gymnasium.spaces.Dict | None = None) -> SimpleNamespace:
    """What the features of a dataset follow from."""
    space = observation_space() if space is None else space
    size = space["agent_pos"].shape[0] if "agent_pos" in space.spaces else 0
    return SimpleNamespace(
        single_observation_space=space,
        single_action_space=gymnasium.spaces.Box(-1, 1, (7,), np.float32),
        state_names=[f"state_{i}" for i in range(size)],
        action_names=["dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper"],
    )


def features(video: bool = True):
    return demonstration_features(world(), video=video)


def images(length: int, seed: int = 0) -> np.ndarray:
    """(length, SIZE, SIZE, 3) uint8; every frame differs from every other of its segment."""
    ramp = np.linspace(40, 120, SIZE, dtype=np.float32)
    rows, columns = np.meshgrid(ramp, ramp, indexing="ij")
    background = np.stack([rows, columns, columns[:, ::-1]], axis=-1)
    frames = np.repeat(background[None], length, axis=0).astype(np.uint8)
    for t in range(length):
        top, left = (14 * t + 8 * seed) % (SIZE - 16), (9 * t + 20 * seed) % (SIZE - 16)
        frames[t, top : top + 16, left : left + 16] = (220, 60 + 10 * (seed % 10), 2 * t % 250)
    return frames


def segment(length: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    done = np.zeros(length, bool)
    done[-1] = True
    return {
        "observation.images.front": images(length, seed),
        "observation.state": rng.normal(size=(length, STATE_DIM)).astype(np.float32),
        "observation.environment_state": rng.normal(size=(length, 3)).astype(np.float32),
        "action": rng.normal(size=(length, 7)).astype(np.float32),
        "next.reward": rng.normal(size=length).astype(np.float32),
        "next.success": rng.random(length) < 0.3,
        "next.done": done,
        "next.truncated": np.zeros(length, bool),
    }


def assert_same_pictures(decoded, written: np.ndarray) -> None:
    """`decoded` (..., 3, H, W) float in [0, 1] is what was `written` (..., H, W, 3) uint8, up to the codec."""
    pixels = np.moveaxis(np.asarray(decoded), -3, -1) * 255
    # Frames of `images` differ from their neighbours by 6.7 at least.
    error = np.abs(pixels - written).mean()
    assert error < 2.5, error
