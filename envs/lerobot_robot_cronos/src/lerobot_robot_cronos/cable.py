"""The cable between a device and the computer, which can come off."""

from lerobot.utils.decorators import check_if_already_connected


class Cable:
    """A device that answers nobody once its cable came off, until it is plugged in and connected anew.

    As LeRobot's devices it does not notice: `is_connected` says that it was opened and not closed.
    """

    _plugged, _opened, _lost = True, False, False

    @property
    def is_connected(self) -> bool:
        """Whether it was opened, and not closed since."""
        return self._opened

    def unplug(self) -> None:
        """The cable comes off."""
        self._plugged, self._lost = False, True

    def plug_in(self) -> None:
        """Somebody plugs it in again. What was open has to be disconnected and connected."""
        self._plugged = True

    @check_if_already_connected
    def _open(self) -> None:
        if not self._plugged:
            raise ConnectionError(f"{type(self).__name__} is not plugged in")
        self._opened, self._lost = True, False

    def _close(self) -> None:
        self._opened = False
