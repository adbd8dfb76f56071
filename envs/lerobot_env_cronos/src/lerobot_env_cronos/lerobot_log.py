"""What LeRobot logs in every command, shortened."""

import logging


class VideoBackendFilter(logging.Filter):
    """Says in one sentence, and once, that videos are decoded by PyAV.

    Without FFmpeg's libraries TorchCodec cannot be loaded, and LeRobot logs its tracebacks, one for each version
    of FFmpeg, whenever a dataset is opened or the flags of `lerobot-train` are read. PyAV brings its own FFmpeg.
    """

    def __init__(self) -> None:
        super().__init__()
        self._said = False

    def filter(self, record: logging.LogRecord) -> bool:
        """Replace LeRobot's message the first time and drop it afterwards; all others stay."""
        if "'torchcodec' is installed but cannot be loaded" not in record.getMessage():
            return True
        record.msg = "Videos are decoded by PyAV; with FFmpeg installed TorchCodec would be about twice as fast."
        record.args = ()
        first, self._said = not self._said, True
        return first


def shorten_video_backend_warning() -> None:
    """Let LeRobot's choice of a video decoder pass through `VideoBackendFilter`."""
    logger = logging.getLogger("lerobot.utils.import_utils")
    if not any(isinstance(old, VideoBackendFilter) for old in logger.filters):
        logger.addFilter(VideoBackendFilter())
