"""The README's reset strategy does what its docstring says."""

import re
from pathlib import Path

import numpy as np

from cronos_lerobot import LoopState
from cronos_lerobot.protocol import ProtocolConfig

README = Path(__file__).parents[1] / "README.md"


def test_the_reset_strategy_resets_after_four_failures_in_a_row():
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names = {}
    exec(code, names)
    strategy = names["AfterFailures"](np.random.default_rng(0), ProtocolConfig())
    loop = LoopState(num_streams=4, num_tasks=4)
    loop.recent_success[:, -5:] = [[1, 0, 0, 0, 0], [0, 0, 0, 0, 1], [-1, -1, 0, 0, 0], [0, 0, 0, 0, 0]]
    # The last one was reset two segments ago: its older failures were in another scene.
    loop.segments_since_reset[:] = [5, 5, 3, 2]
    assert strategy.due(None, loop).tolist() == [0]
