"""A sheet of pictures of streams: one row for each stream, one picture for the end of each segment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from lerobot_env_cronos import CronosVectorEnv
from PIL import Image

from cronos_lerobot.report.overlay import Status, draw_status

PICTURE = (320, 240)
"""Width and height of a picture on the sheet [px]; rendered at the environment's `render_size`."""
GAP = 6


def draw_stream_sheet(
    env: CronosVectorEnv,
    positions: np.ndarray,
    instructions: Sequence[Sequence[str]],
    success: np.ndarray,
    starts: Sequence[Sequence[str]],
    *,
    streams: Sequence[int],
    segments: Sequence[int],
) -> Image.Image:
    """Draw the chosen streams at the end of the chosen segments.

    Args:
        env: draws.
        positions: (num_segments, num_streams, nq) at the end of every segment.
        instructions: [segment][stream].
        success: (num_segments, num_streams) bool, the task was complete after any step.
        starts: [segment][stream], how the scene lay when the task was given, in words.
        streams: rows of the sheet.
        segments: columns of the sheet.
    """
    width, height = PICTURE
    size = (len(segments) * (width + GAP) + GAP, len(streams) * (height + GAP) + GAP)
    sheet = Image.new("RGB", size, "white")
    for row, stream in enumerate(streams):
        for column, segment in enumerate(segments):
            done = bool(success[segment, stream])
            status = Status(
                instructions[segment][stream], segment, len(positions), succeeded=done, interventions=0,
                outcomes=success[: segment + 1, stream].tolist(), caption=f"stream {stream}",
                message=starts[segment][stream],
            )  # fmt: skip
            frame = draw_status(env.render_positions(positions[segment, stream][None])[0], status)
            picture = Image.fromarray(frame).resize(PICTURE, Image.Resampling.LANCZOS)
            sheet.paste(picture, (GAP + column * (width + GAP), GAP + row * (height + GAP)))
    return sheet
