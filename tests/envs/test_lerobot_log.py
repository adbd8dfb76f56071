"""What a machine without FFmpeg's libraries shows when LeRobot opens datasets."""

import os
import subprocess
import sys


def test_without_ffmpeg_the_decoder_is_named_in_one_sentence_and_once(tmp_path):
    # As TorchCodec fails there: at its import, with the tracebacks of every library that it tried in the message.
    (tmp_path / "torchcodec.py").write_text(
        "raise RuntimeError('Could not load libtorchcodec.\\n[start of traceback]\\nTraceback (most recent call"
        " last):\\n  File x\\nOSError: libavutil.so.60: cannot open shared object file\\n[end of traceback].')"
    )
    code = """
import logging
logging.basicConfig(format="%(levelname)s %(message)s")
import lerobot_env_cronos
from lerobot.utils.import_utils import get_safe_default_video_backend
print([get_safe_default_video_backend() for _ in range(3)])
logging.getLogger("lerobot.utils.import_utils").warning("something else")
"""
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
        check=True,
    )
    assert done.stdout == "['pyav', 'pyav', 'pyav']\n"
    sentence = "Videos are decoded by PyAV; with FFmpeg installed TorchCodec would be about twice as fast."
    assert done.stderr == f"WARNING {sentence}\nWARNING something else\n"
