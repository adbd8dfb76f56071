"""The cameras of the simulated arm."""

from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.decorators import check_if_not_connected
from lerobot_env_cronos.simulation.rendering import make_renderer

from lerobot_robot_cronos.cable import Cable
from lerobot_robot_cronos.desk import Desk


class SimulatedCamera(Cable, Camera):
    """Draws the scene as it is when it is asked, (height, width, 3) uint8 RGB.

    An unplugged camera raises a RuntimeError at each access, as LeRobot's OpenCV camera does.
    """

    def __init__(self, desk: Desk, name: str, height: int, width: int):
        super().__init__(CameraConfig(fps=round(desk.world.fps), width=width, height=height))
        self._desk, self._name, self._size = desk, name, (height, width)

    def connect(self, warmup: bool = True) -> None:
        """See `Camera`."""
        self._open()
        model = self._desk.world.simulation.render_model
        self._renderer = make_renderer("classic", model, *self._size, self._name)

    @check_if_not_connected
    def disconnect(self) -> None:
        """See `Camera`."""
        self._renderer.close()
        self._close()

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """None is plugged into the computer."""
        return []

    @check_if_not_connected
    def read(self) -> np.ndarray:
        """A picture of the scene now."""
        if self._lost:
            raise RuntimeError(f"{type(self).__name__}({self._name}) read thread is not running.")
        self._desk.catch_up()
        return self._renderer.render(self._desk.world.simulation.qpos)[0]

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The same as `read`."""
        return self.read()

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """The same as `read`."""
        return self.read()
