"""LeRobot's reward classifiers, one for each task, as the judge of practice.

A checkpoint may come from a stranger. LeRobot loads the encoder that it names with `trust_remote_code=True`, and
processors by whatever class they name. Here the encoder must be one of transformers' own, or LeRobot's default.
The processors are those that LeRobot gives a classifier.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import draccus
import numpy as np
import torch
from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from lerobot.configs.rewards import RewardModelConfig
from lerobot.processor import PolicyProcessorPipeline
from lerobot.rewards import make_reward_model
from lerobot.rewards.classifier.configuration_classifier import RewardClassifierConfig
from lerobot.utils.constants import OBS_IMAGE, OBS_IMAGES
from safetensors import SafetensorError
from torchvision.transforms.v2.functional import resize

from cronos_lerobot.robot.person import Events

KIND = "reward_classifier"
PROCESSOR = "classifier_preprocessor.json"
LAST = Path("checkpoints/last/pretrained_model")
"""Of a folder that `lerobot-train` wrote."""
STEPS = ("normalizer_processor", "device_processor")
"""What LeRobot gives a classifier. Other steps of LeRobot load models."""
EVERY = 3
"""Control steps from one verdict to the next; the encoder takes longer than the policy."""
STEADY = 10
"""Verdicts in a row that make a success, 1 s at 30 Hz. Single ones flicker, and one counts for its segment."""
FILES = (CONFIG_NAME, PROCESSOR, SAFETENSORS_SINGLE_FILE)


class RewardModelJudge:
    """Complete once LeRobot's classifier of the task has called STEADY pictures in a row a success.

    It must have called one a failure before: where a task began complete, nothing had to be done.

    Args:
        folder: with a sub-folder for each task, its instruction with underscores: what `lerobot-train` wrote, or a
            checkpoint.
        tasks: each has a classifier.
        reset_tasks: may have one.
        cameras: names of the robot's.

    Raises:
        ValueError: a task has no classifier, or one is damaged, needs other cameras, or brings code of its own.
    """

    def __init__(
        self, folder: Path, tasks: Sequence[Any], reset_tasks: Sequence[Any], cameras: Mapping[str, Any]
    ) -> None:
        places = {task.instruction: folder / task.instruction.replace(" ", "_") for task in (*tasks, *reset_tasks)}
        if missing := [places[task.instruction].name for task in tasks if not places[task.instruction].is_dir()]:
            there = sorted(path.name for path in folder.iterdir() if path.is_dir())
            raise ValueError(
                f"--env.judge={folder} needs the folders {missing}, one for each task; it has {there}"
            )
        self._models = {text: RewardModel(place) for text, place in places.items() if place.is_dir()}
        for text, model in self._models.items():
            if unknown := set(model.cameras) - set(cameras):
                raise ValueError(f"{places[text]} looks at {sorted(unknown)}; the robot has {sorted(cameras)}")
        digest = hashlib.sha256("".join(model.digest for model in self._models.values()).encode())
        self.name = f"{KIND} {digest.hexdigest()[:8]}"

    def begin(self, task: Any) -> None:
        """See `Judge`."""
        if task.instruction not in self._models:
            raise ValueError(f"--env.judge has no model for {task.instruction!r}, only for {list(self._models)}")
        self._task, self._step = task.instruction, 0
        self._in_a_row: int | None = None

    def judge(self, observation: Mapping[str, Any], events: Events) -> bool:
        """See `Judge`."""
        if self._step % EVERY == 0:
            model = self._models[self._task]
            says = model.successes({camera: observation[camera][None] for camera in model.cameras})[0]
            if not says:
                self._in_a_row = 0
            elif self._in_a_row is not None:
                self._in_a_row += 1
        self._step += 1
        return (self._in_a_row or 0) >= STEADY


class RewardModel:
    """A checkpoint of LeRobot's reward classifier.

    Args:
        folder: the checkpoint, or what `lerobot-train` wrote.

    Raises:
        ValueError: see `RewardModelJudge`.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / CONFIG_NAME).is_file():
            folder /= LAST
        if missing := [name for name in FILES if not (folder / name).is_file()]:
            raise ValueError(f"{folder} is no checkpoint of a {KIND}: it lacks {missing}")
        self.digest = hashlib.sha256(b"".join((folder / name).read_bytes() for name in FILES)).hexdigest()
        try:
            self._load(folder)
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            RuntimeError,
            SafetensorError,
            draccus.ParsingError,
        ) as error:
            raise ValueError(f"{folder} cannot judge: {error}") from error

    def _load(self, folder: Path) -> None:
        kind = json.loads((folder / CONFIG_NAME).read_text()).get("type")
        if kind != KIND:
            raise ValueError(f"it is of the type {kind!r}; valid: {KIND!r}")
        steps = json.loads((folder / PROCESSOR).read_text())["steps"]
        if unknown := [step for step in steps if step.get("registry_name") not in STEPS or "class" in step]:
            raise ValueError(f"{PROCESSOR} has the steps {unknown}, which are not run; valid: {STEPS}")
        config = RewardModelConfig.from_pretrained(folder)
        config.pretrained_path, config.pretrained_revision = str(folder), None
        assert isinstance(config, RewardClassifierConfig)
        with _encoder_without_code(config.model_name):
            self._model: Any = make_reward_model(config)
        self._preprocess: Any = PolicyProcessorPipeline.from_pretrained(
            folder, PROCESSOR, overrides={"device_processor": {"device": config.device}}, local_files_only=True
        )
        self._shapes = {
            key.removeprefix(f"{OBS_IMAGES}."): feature.shape
            for key, feature in config.input_features.items()
            if key.startswith(OBS_IMAGE)
        }

    @property
    def cameras(self) -> list[str]:
        """Names of those that it looks through."""
        return list(self._shapes)

    def successes(self, pictures: Mapping[str, np.ndarray]) -> np.ndarray:
        """Its verdicts on n moments (n,) bool.

        Args:
            pictures: (n, H, W, 3) uint8 of each of its cameras, of any size.
        """
        batch = {}
        for camera, (_, height, width) in self._shapes.items():
            picture = torch.tensor(pictures[camera]).permute(0, 3, 1, 2).float() / 255
            # As LeRobot's transform of pictures in training does.
            batch[f"{OBS_IMAGES}.{camera}"] = resize(picture, [height, width], antialias=True)
        with torch.inference_mode():
            return self._model.compute_reward(self._preprocess(batch)).cpu().numpy() > 0.5


@contextmanager
def _encoder_without_code(name: str) -> Generator[None]:
    """While a model is loaded, transformers runs no code that comes with its encoder `name`.

    LeRobot's own default is what LeRobot's makers published, and has code.
    """
    from transformers import AutoModel

    if name == RewardClassifierConfig.model_name and not Path(name).exists():
        yield
        return
    load = AutoModel.from_pretrained
    with patch.object(
        AutoModel, "from_pretrained", lambda path, **flags: load(path, **flags | {"trust_remote_code": False})
    ):
        yield
