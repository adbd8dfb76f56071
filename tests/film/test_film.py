"""Films of streams: the overlay shows outcomes, files play, the task sheet is whole."""

from io import BytesIO

import av
import numpy as np
import pytest
from lerobot_env_cronos import load_benchmark
from PIL import Image

from cronos_lerobot.film.encode import write_mp4
from cronos_lerobot.film.overlay import FAILURE, SUCCESS, Status, draw_status
from cronos_lerobot.hub.pictures import task_sheet


def test_overlay_shows_outcomes():
    status = Status("put the cloth away", 2, 3, succeeded=False, caption="task 3/3", outcomes=[True, False])
    drawn = draw_status(np.zeros((480, 640, 3), np.uint8), status)
    bottom = {tuple(int(c) for c in color) for color in drawn[460, 560:]}
    assert {SUCCESS, FAILURE} <= bottom
    assert SUCCESS not in {tuple(int(c) for c in color) for color in drawn[20, 560:]}


def test_mp4_plays_every_frame(tmp_path):
    ramp = np.linspace(0, 150, 160, dtype=np.uint8)[None, :, None]
    frames = [np.broadcast_to(ramp + np.uint8(i), (120, 160, 3)) for i in range(60)]
    with pytest.raises(ValueError, match="uint8"):
        write_mp4(tmp_path / "a/stream.mp4", [frame.astype(float) for frame in frames], fps=20)
    assert not (tmp_path / "a/stream.mp4").exists()
    write_mp4(tmp_path / "a/stream.mp4", frames, fps=20)
    with av.open(str(tmp_path / "a/stream.mp4")) as container:
        decoded = list(container.decode(video=0))
        assert container.streams.video[0].average_rate == 20
    assert len(decoded) == 60
    error = np.abs(decoded[30].to_ndarray(format="rgb24").astype(int) - frames[30])
    assert error.mean() < 6


def test_sheet_has_every_task_from_both_cameras():
    sheet = Image.open(BytesIO(task_sheet(load_benchmark(None, "kitchen_2x2"))))
    assert sheet.size == (2 * 654 + 14, 2 * 288 + 14)
    corners = [(14 + 654 * column + 320 * camera, 48 + 288 * row) for row, column, camera in np.ndindex(2, 2, 2)]
    pictures = {sheet.crop((x, y, x + 320, y + 240)).tobytes() for x, y in corners}
    assert len(pictures) == 8
