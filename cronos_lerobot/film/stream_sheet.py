"""A sheet of pictures of streams, with what happens in them written on each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from lerobot_env_cronos import CronosVectorEnv
from PIL import Image

from cronos_lerobot.film.overlay import Status, draw_status

PICTURE = (320, 240)
"""Width and height of a picture on the sheet [px]; rendered at the environment's `render_size`."""
GAP = 6


def draw_stream_sheet(env: CronosVectorEnv, rows: Sequence[Sequence[tuple[np.ndarray, Status]]]) -> Image.Image:
    """Draw a sheet of pictures.

    Args:
        env: draws.
        rows: of the sheet, all of one length: a state (nq,), see `CronosVectorEnv.positions`, and its overlay.
    """
    width, height = PICTURE
    sheet = Image.new("RGB", (len(rows[0]) * (width + GAP) + GAP, len(rows) * (height + GAP) + GAP), "white")
    for i, row in enumerate(rows):
        frames = env.render_positions(np.stack([positions for positions, _ in row]))
        for j, (frame, (_, status)) in enumerate(zip(frames, row, strict=True)):
            picture = Image.fromarray(draw_status(frame, status)).resize(PICTURE, Image.Resampling.LANCZOS)
            sheet.paste(picture, (GAP + j * (width + GAP), GAP + i * (height + GAP)))
    return sheet
