"""Encoders of videos."""

import os
import sys

import numpy as np
import pytest
from lerobot.configs import RGBEncoderConfig
from synthetic_segments import FPS

from cronos_lerobot.data.video import VideoFile


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks Linux for the priorities of threads")
def test_the_encoder_of_av1_leaves_everything_its_priority(tmp_path):
    """As root it makes itself and its caller SCHED_FIFO at 99."""
    with VideoFile(tmp_path / "a.mp4", FPS, 64, 64, RGBEncoderConfig(vcodec="libsvtav1", preset=12)) as video:
        video.append(np.zeros((3, 64, 64, 3), np.uint8))
        threads = [int(thread) for thread in os.listdir("/proc/self/task")]
        assert {os.sched_getscheduler(thread) for thread in threads} <= {os.SCHED_OTHER, os.SCHED_BATCH}
