"""Mp4 files that hold many episodes back to back: encoded from memory, copied from other files, and read."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import IO, Self, cast

import av
import numpy as np
from lerobot.configs import RGBEncoderConfig

MAX_FILE_DURATION_S = 1000.0
"""LeRobot compares timestamps inside a file in float32 with a tolerance of 1e-4 s. From 1024 s on, float32
steps are wider than that, so a longer file has frames that LeRobot cannot find."""


def fast_encoder() -> RGBEncoderConfig:
    """h264 at its fastest preset, a keyframe every second frame as in LeRobot's default, yuv420p."""
    return RGBEncoderConfig(vcodec="h264", preset="ultrafast", g=2, crf=18)


def check_video_size(flag: str, size: Sequence[int]) -> None:
    """Raise a ValueError, unless pictures of a `size`, (height, width) [px], can be a video's: it halves both."""
    height, width = size
    if height % 2 or width % 2:
        raise ValueError(f"{flag} are {height} and {width}: both must be even for a video")


class VideoFile:
    """One mp4 being written. Frame k lies at exactly k / fps seconds."""

    def __init__(
        self, path: Path, fps: int, height: int, width: int, encoder: RGBEncoderConfig | None = None
    ) -> None:
        """Open `path` (its folder must exist) for frames of `height` x `width` pixels."""
        encoder = encoder or fast_encoder()
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

    def fits(self, frames: np.ndarray) -> bool:
        """Whether the file takes an episode: any."""
        return True

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
            try:
                self._mux(None)
            finally:
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


@dataclass(frozen=True)
class Clip:
    """Frames `start` to `start + length - 1` of an mp4."""

    path: Path
    start: int
    length: int


class CopiedVideoFile:
    """One mp4 being put together from clips of others, packet by packet: nothing is decoded, no quality is lost.

    All clips must begin at a keyframe and come from the same encoder with the same settings.
    """

    def __init__(self, path: Path, fps: int, *_size: int) -> None:
        """Open `path` (its folder must exist)."""
        self.num_frames = 0
        self._fps = fps
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        self._stream: av.VideoStream | None = None
        self._source: tuple[Path, av.container.InputContainer] | None = None

    def fits(self, clip: Clip) -> bool:
        """Whether `clip` is encoded as those before it are."""
        source = self._open(clip.path)
        stream = self._stream
        return stream is None or (
            source.codec_context.extradata == stream.codec_context.extradata
            and (source.width, source.height) == (stream.width, stream.height)
        )

    def append(self, clip: Clip) -> None:
        """Copy a clip.

        Raises:
            ValueError: it does not begin at a keyframe, or its frames are not stored in their order.
        """
        source = self._open(clip.path)
        if self._stream is None:
            self._stream = self._container.add_stream_from_template(source)
            self._stream.time_base = Fraction(1, self._fps)
        copied = 0
        for number, packet in _packets(source, clip.start, self._fps):
            if (
                number != clip.start + copied
                or packet.pts != packet.dts
                or (not copied and not packet.is_keyframe)
            ):
                raise ValueError(
                    f"{clip.path} cannot be copied without decoding from frame {clip.start} on: packet {copied} is"
                    f" frame {number}"
                )
            packet.stream = self._stream
            packet.time_base = Fraction(1, self._fps)
            packet.pts = packet.dts = self.num_frames
            packet.duration = 1
            self._container.mux(packet)
            self.num_frames += 1
            copied += 1
            if copied == clip.length:
                return
        raise ValueError(f"{clip.path} ends after {copied} of {clip.length} frames from frame {clip.start} on")

    def close(self) -> None:
        """Write the file's index."""
        if self._source is not None:
            self._source[1].close()
        self._container.close()

    def _open(self, path: Path) -> av.VideoStream:
        if self._source is None or self._source[0] != path:
            if self._source is not None:
                self._source[1].close()
            self._source = path, av.open(str(path))
        return self._source[1].streams.video[0]


def read_frames(file: str | Path | IO[bytes], start: int, length: int, fps: int) -> np.ndarray:
    """Decode frames `start` to `start + length - 1` of an mp4 of `VideoFile`: uint8 (length, H, W, 3) RGB.

    Raises:
        ValueError: the file ends before.
    """
    frames: list[np.ndarray] = []
    with av.open(str(file) if isinstance(file, Path) else file, "r") as container:
        stream = container.streams.video[0]
        _seek(stream, start, fps)
        for frame in container.decode(stream):
            if frame.time is not None and round(frame.time * fps) >= start:
                frames.append(frame.to_ndarray(format="rgb24"))
            if len(frames) == length:
                break
    if len(frames) < length:
        raise ValueError(f"{file} ends after {len(frames)} of {length} frames from frame {start} on")
    return np.stack(frames)


def _packets(stream: av.VideoStream, start: int, fps: int) -> Iterator[tuple[int, av.Packet]]:
    """The packets of a file from the last keyframe up to frame `start` on, with their frame numbers."""
    _seek(stream, start, fps)
    for packet in cast(av.container.InputContainer, stream.container).demux(stream):
        if packet.pts is not None and packet.time_base is not None:
            yield round(packet.pts * packet.time_base * fps), packet


def _seek(stream: av.VideoStream, start: int, fps: int) -> None:
    assert stream.time_base is not None
    cast(av.container.InputContainer, stream.container).seek(round(start / fps / stream.time_base), stream=stream)
