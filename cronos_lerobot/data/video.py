"""Encodes frames from memory into one mp4 that holds many episodes back to back."""

from fractions import Fraction
from pathlib import Path
from typing import Self, cast

import av
import numpy as np
from lerobot.configs import RGBEncoderConfig

MAX_FILE_DURATION_S = 1000.0
"""LeRobot compares timestamps inside a file in float32 with a tolerance of 1e-4 s. From 1024 s on, float32
steps are wider than that, so a longer file has frames that LeRobot cannot find."""


def fast_encoder() -> RGBEncoderConfig:
    """h264 at its fastest preset, a keyframe every second frame as in LeRobot's default, yuv420p."""
    return RGBEncoderConfig(vcodec="h264", preset="ultrafast", g=2, crf=18)


class VideoFile:
    """One mp4 being written. Frame k lies at exactly k / fps seconds."""

    def __init__(self, path: Path, fps: int, height: int, width: int, encoder: RGBEncoderConfig) -> None:
        """Open `path` (its folder must exist) for frames of `height` x `width` pixels."""
        # LeRobot's video probing leaves libav printing at INFO level, a page of x264 statistics per file.
        av.logging.set_libav_level(av.logging.ERROR)
        self.path = path
        self.num_frames = 0
        self._closed = False
        self._time_base = Fraction(1, fps)
        # The moov atom goes to the front, so that a reader over HTTP needs no second request.
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        # One thread: at these sizes libx264's own threads cost more than they bring.
        options = encoder.get_codec_options(encoder_threads=1, as_strings=True)
        stream = self._container.add_stream(encoder.vcodec, fps, options=options)
        self._stream = cast(av.VideoStream, stream)
        self._stream.pix_fmt = encoder.pix_fmt
        self._stream.height = height
        self._stream.width = width
        self._stream.time_base = self._time_base

    def append(self, frames: np.ndarray) -> None:
        """Encode an episode, uint8 (T, H, W, 3) RGB; its first frame becomes a keyframe."""
        expected = (self._stream.height, self._stream.width, 3)
        if frames.dtype != np.uint8 or frames.shape[1:] != expected:
            raise ValueError(f"frames must be uint8 (T, *{expected}), got {frames.dtype} {frames.shape}")
        for i, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts = self.num_frames
            frame.time_base = self._time_base
            if i == 0:
                frame.pict_type = av.video.frame.PictureType.I
            self._mux(frame)
            self.num_frames += 1

    def close(self) -> None:
        """Drain the encoder and write the file's index. Idempotent."""
        if not self._closed:
            self._closed = True
            self._mux(None)
            self._container.close()

    def __enter__(self) -> Self:
        """The open file."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Close the file."""
        self.close()

    def _mux(self, frame: av.VideoFrame | None) -> None:
        for packet in self._stream.encode(frame):
            packet.duration = 1  # in the stream's time base; without it a file's last frame lasts 0 s
            self._container.mux(packet)
