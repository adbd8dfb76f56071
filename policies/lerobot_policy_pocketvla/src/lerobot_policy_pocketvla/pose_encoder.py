"""The picture encoder: it says where the bodies are, and is taught so where the data knows."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from lerobot_policy_pocketvla.bodies import (
    BODY_WIDTH,
    DOUBLED_YAW,
    FROM_HAND,
    POSITION,
    POSITION_UNIT_M,
    ROTATION,
)

MEAN_BATCHES = 100
"""Batches over which the mean picture is taken."""
PICTURE_UNIT = 38.0
"""Grey levels that 1 stands for after the mean picture is subtracted."""
RESIDUAL_M = 0.03
"""Length that 1 stands for in what is added to a body's place on the table [m]."""
FEATURES = 32
"""Of each cell of the maps."""
FREE_MAPS = 8
"""Maps that nobody supervises."""
HIDDEN_WIDTH = 256
ROTATION_WEIGHT = 0.3
"""Of rotations in the loss, against lengths in units of `RESIDUAL_M`."""
SMOOTH = 0.1
"""Error up to which the loss is a square."""


@dataclass(frozen=True)
class View:
    """What a camera sees of the bodies.

    Args:
        projection: (3, 4); times a point (x, y, z, 1) [m] it is (u w, v w, w): u to the right and v downwards lie
            in [-1, 1] inside the picture.
        keypoints: for each body some points in its own frame [m], first its centre, (0, 0, 0).
    """

    projection: list[list[float]]
    keypoints: list[list[list[float]]]


class PoseEncoder(nn.Module):
    """Three convolutions and maps, read out at the bodies.

    A softmax makes of each map where something is. The features at each body's map, these places and the
    proprioception go through two layers. A body lies where its ray meets the table, and the layers say how far
    from there it is.

    Without a `view` nothing is known of the bodies, and the encoding is the hidden layer's.

    Args:
        state_width: of the normalised proprioception.
        hand: indices of the hand's position in it, 3, if it is there.
        view: of the camera.
        size: height and width of the pictures [px].
        bfloat16: run the convolutions in bfloat16; all that follows them is float32.
    """

    mean_picture: Tensor
    mean_batches: Tensor
    projection: Tensor
    to_table: Tensor
    keypoint_body: Tensor
    keypoint_offset: Tensor

    def __init__(
        self, state_width: int, hand: list[int], view: View | None, size: tuple[int, int], bfloat16: bool
    ) -> None:
        """Build the layers."""
        super().__init__()
        self.use_bfloat16 = bfloat16
        self.num_bodies = len(view.keypoints) if view else 0
        points = sum(len(points) for points in view.keypoints) if view else 0
        self.conv1 = nn.Conv2d(3, 16, 4, stride=2, padding=1)
        self.conv2 = nn.Conv2d(16, FEATURES, 3, stride=2, padding=1)
        self.conv3 = nn.Conv2d(FEATURES, FEATURES, 3, padding=1)
        for convolution in (self.conv1, self.conv2, self.conv3):
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        self.maps = points + FREE_MAPS
        self.to_maps = nn.Conv2d(FEATURES, self.maps, 1)
        # The features at every body, or, where none is known, at every map.
        self.read_at = self._centres(view) if view else list(range(self.maps))
        inputs = 2 * self.maps + FEATURES * len(self.read_at) + state_width
        self.readout = nn.Sequential(
            nn.Linear(inputs, HIDDEN_WIDTH), nn.SiLU(), nn.Linear(HIDDEN_WIDTH, HIDDEN_WIDTH), nn.SiLU()
        )
        self.register_buffer("mean_picture", torch.zeros(3, *size))
        self.register_buffer("mean_batches", torch.zeros((), dtype=torch.int64))
        self.width = HIDDEN_WIDTH
        self.hand = hand
        if view:
            self._build_poses(view)

    def _build_poses(self, view: View) -> None:
        self.width = BODY_WIDTH * self.num_bodies
        self.to_poses = nn.Linear(HIDDEN_WIDTH, self.num_bodies * 11)
        nn.init.zeros_(self.to_poses.bias)
        with torch.no_grad():
            self.to_poses.weight.mul_(0.1)
        # The hand's position [0.1 m], of the normalised proprioception.
        self.to_hand = nn.Linear(len(self.hand), 3)
        projection = torch.tensor(view.projection)
        self.register_buffer("projection", projection, persistent=False)
        # Of points on the table (x, y, 0, 1); its inverse leads from the picture back to them.
        self.register_buffer("to_table", torch.linalg.inv(projection[:, [0, 1, 3]]), persistent=False)
        body = [b for b, points in enumerate(view.keypoints) for _ in points]
        self.register_buffer("keypoint_body", torch.tensor(body), persistent=False)
        offsets = torch.tensor([point for points in view.keypoints for point in points])
        self.register_buffer("keypoint_offset", offsets, persistent=False)

    @staticmethod
    def _centres(view: View) -> list[int]:
        sizes = [len(points) for points in view.keypoints]
        return [sum(sizes[:body]) for body in range(len(sizes))]

    def forward(self, images: Tensor, state: Tensor) -> Tensor:
        """Images (B, 3, H, W), uint8 or in [0, 1], and proprioception (B, P) to encodings (B, width), float32.

        With a view they are what `describe_bodies` says, (B, 14 bodies).
        """
        hidden, places = self._read(*self._look(images), state)
        return self._described(self._poses(hidden, places), state) if self.num_bodies else hidden

    def teach(self, images: Tensor, state: Tensor, bodies: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """How well the encoder says where the bodies are.

        Args:
            images: as in `forward`.
            state: as in `forward`.
            bodies: the truth, (B, 14 bodies), of `describe_bodies`.

        Returns:
            The encodings, the losses (B,), differentiable, and the errors of the positions (B, bodies) [m].
        """
        maps, features = self._look(images)
        poses = self._poses(*self._read(maps, features, state))
        truth = bodies.unflatten(-1, (self.num_bodies, BODY_WIDTH))
        target = torch.cat((truth[..., ROTATION], truth[..., DOUBLED_YAW]), dim=-1)
        distance = (poses[..., :3] - truth[..., POSITION]) * (POSITION_UNIT_M / RESIDUAL_M)
        turned = poses[..., 3:] - target
        hand = self.to_hand(state[:, self.hand]) - (truth[:, 0, POSITION] - truth[:, 0, FROM_HAND])
        loss = _smooth(distance).sum(-1).mean(-1) + ROTATION_WEIGHT * _smooth(turned).sum(-1).mean(-1)
        loss = loss + _smooth(hand * (POSITION_UNIT_M / RESIDUAL_M)).sum(-1)
        loss = loss + self._surprise(maps, truth)
        return self._described(poses, state), loss, (distance.detach() * RESIDUAL_M).norm(dim=-1)

    def _look(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Maps (B, maps, h, w) and features (B, FEATURES, h, w), float32."""
        x = _grey_levels(images).sub_(self.mean_picture).div_(PICTURE_UNIT)
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=self.use_bfloat16):
            x = F.relu(self.conv1(x))
            x = F.relu(self.conv2(x))
            x = F.relu(self.conv3(x))
            maps = self.to_maps(x)
        return maps.float(), x.float()

    def _read(self, maps: Tensor, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """What the layers make of it (B, HIDDEN_WIDTH), and where each map is looking (B, maps, 2)."""
        weights = maps.flatten(2).softmax(-1)
        places = weights @ _grid(maps).flatten(0, 1)
        at_bodies = weights[:, self.read_at] @ features.flatten(2).transpose(1, 2)
        return self.readout(torch.cat((places.flatten(1), at_bodies.flatten(1), state), dim=-1)), places

    def _poses(self, hidden: Tensor, places: Tensor) -> Tensor:
        """Poses (B, bodies, 11): position [0.1 m], rotation, doubled yaw."""
        poses = self.to_poses(hidden).unflatten(-1, (self.num_bodies, 11))
        metres = self._on_table(places[:, self.read_at]) + RESIDUAL_M * poses[..., :3]
        return torch.cat((metres / POSITION_UNIT_M, poses[..., 3:]), dim=-1)

    def _described(self, poses: Tensor, state: Tensor) -> Tensor:
        """Poses as `describe_bodies` has them, (B, 14 bodies)."""
        position, rotation, yaw = poses.split((3, 6, 2), dim=-1)
        from_hand = position - self.to_hand(state[:, self.hand])[:, None]
        return torch.cat((position, rotation, from_hand, yaw), dim=-1).flatten(1)

    def _on_table(self, places: Tensor) -> Tensor:
        """Where the rays through places (B, bodies, 2) of the picture meet the table, (B, bodies, 3) [m]."""
        ray = torch.cat((places, torch.ones_like(places[..., :1])), dim=-1) @ self.to_table.T
        level = ray[..., :2] / ray[..., 2:]
        return torch.cat((level, torch.zeros_like(level[..., :1])), dim=-1)

    def _surprise(self, maps: Tensor, truth: Tensor) -> Tensor:
        """Cross-entropy of the supervised maps with the points they are of, mean over the points, (B,)."""
        position = truth[..., POSITION] * POSITION_UNIT_M
        first, second = truth[..., 3:6], truth[..., 6:9]
        rotation = torch.stack((first, second, torch.linalg.cross(first, second)), dim=-1)
        offset = torch.einsum("nkij,kj->nki", rotation[:, self.keypoint_body], self.keypoint_offset)
        point = position[:, self.keypoint_body] + offset
        seen = torch.cat((point, torch.ones_like(point[..., :1])), dim=-1) @ self.projection.T
        places = seen[..., :2] / seen[..., 2:]
        target = _bilinear(places, maps.shape[-2:])
        supervised = maps[:, : len(self.keypoint_body)].flatten(2).log_softmax(-1)
        return -(target * supervised).sum(-1).mean(-1)

    @torch.no_grad()
    def count_in(self, images: Tensor) -> None:
        """Let the mean picture be that of the first batches up to this one."""
        if self.mean_batches < MEAN_BATCHES:
            self.mean_batches += 1
            self.mean_picture += (_grey_levels(images).mean(0) - self.mean_picture) / self.mean_batches


def _grey_levels(images: Tensor) -> Tensor:
    """Images, uint8 or in [0, 1], as new floats in [0, 255]."""
    return images.float() if images.dtype == torch.uint8 else 255.0 * images.float()


def _smooth(error: Tensor) -> Tensor:
    return F.smooth_l1_loss(error, torch.zeros_like(error), beta=SMOOTH, reduction="none")


def _grid(maps: Tensor) -> Tensor:
    """Places (h, w, 2) of the cells of maps (..., h, w): x and y in [-1, 1]."""
    height, width = maps.shape[-2:]
    x = (2 * torch.arange(width, device=maps.device) + 1) / width - 1
    y = (2 * torch.arange(height, device=maps.device) + 1) / height - 1
    return torch.stack((x.expand(height, width), y[:, None].expand(height, width)), dim=-1)


def _bilinear(places: Tensor, size: Sequence[int]) -> Tensor:
    """Weights (B, K, h w) of the four cells around places (B, K, 2); none for what lies outside the picture."""
    height, width = size
    x = (places[..., 0] + 1) * (width / 2) - 0.5
    y = (places[..., 1] + 1) * (height / 2) - 0.5
    columns = (1 - (x[..., None] - torch.arange(width, device=x.device)).abs()).clamp(min=0)
    rows = (1 - (y[..., None] - torch.arange(height, device=y.device)).abs()).clamp(min=0)
    return (rows[..., :, None] * columns[..., None, :]).flatten(-2)
