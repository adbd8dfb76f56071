"""What the agent's values chose, as logged: tasks (`task_order=critic`) and resets (`scene_reset=critic`)."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import LoopState, SegmentEnd


class CriticLog:
    """The values of the tasks that were given and of the streams that were reset; of other protocols nothing.

    Args:
        protocol: of the run.
    """

    def __init__(self, protocol: ProtocolConfig) -> None:
        self.chooses_tasks = protocol.task_order == "critic"
        self.asks_for_resets = protocol.scene_reset == "critic"
        self._state: dict[str, Any] = {"values": _no_values(), "resets": [], "popped": 0, "counted": None}

    def on_segment(self, segment: SegmentEnd, loop: LoopState) -> None:
        """Take in the end of a segment; its resets are done."""
        if self.chooses_tasks:
            columns = (segment.task, segment.success, loop.task_value, segment.taken_over)
            for task, success, value, taken_over in zip(*columns, strict=True):
                if task < loop.num_tasks and not taken_over:
                    self._state["values"]["success" if success else "failure"].append(float(value))
        counts = loop.asked_resets
        before, self._state["counted"] = self._state["counted"] or [0] * len(counts), counts.tolist()
        if self.asks_for_resets:
            resets = [
                {
                    "interaction_steps": loop.n,
                    "stream": stream,
                    "segments": int(segment.segments_since_reset[stream]) + 1,
                    "value": float(loop.reset_value[stream]),
                }
                for stream in np.flatnonzero(counts > before).tolist()
            ]
            self._state["resets"] += resets

    def pop(self) -> dict[str, Any]:
        """What was chosen since the last `pop`, under `critic`; {} if nothing goes by values.

        `task_value` is the mean value of the tasks when they were given, also of those that were then a success
        or a failure; `resets` are the scene resets one by one: when, which stream, after how many segments since
        its last one, at which best value over the tasks.
        """
        record: dict[str, Any] = {}
        if self.chooses_tasks:
            values = self._state["values"]
            record["task_value"] = _mean(values["success"] + values["failure"])
            record |= {f"task_value_of_{name}": _mean(values[name]) for name in ("success", "failure")}
        if self.asks_for_resets:
            record["resets"] = self._state["resets"][self._state["popped"] :]
        self._state |= {"values": _no_values(), "popped": len(self._state["resets"])}
        return {"critic": record} if record else {}

    def summary(self) -> dict[str, Any] | None:
        """How the whole run's scene resets were spent; None unless values asked for them.

        Numbers of resets by stream, by segments since the stream's last one, and by best value over the tasks, in
        bins of 0.1 that are named by their lower bounds.
        """
        if not self.asks_for_resets:
            return None
        resets = self._state["resets"]
        segments = Counter(reset["segments"] for reset in resets)
        values = Counter(math.floor(10 * reset["value"]) for reset in resets)
        streams = Counter(reset["stream"] for reset in resets)
        return {
            "scene_resets": len(resets),
            "by_stream": {str(stream): streams[stream] for stream in sorted(streams)},
            "by_segments": {str(number): segments[number] for number in sorted(segments)},
            "by_value": {f"{tenths / 10:.1f}": values[tenths] for tenths in sorted(values)},
        }

    def state_dict(self) -> dict[str, Any]:
        """All that was taken in."""
        return self._state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        self._state = state


def _no_values() -> dict[str, list[float]]:
    return {"success": [], "failure": []}


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
