"""Algorithm 1 of the paper: multi-task reset-free reinforcement learning (RF-MTRL).

The numbers are the paper's lines. The paper writes one stream; here every line is done for all N streams at
once, and its n and b are sums over them. Whoever logs, records, evaluates or saves does so between events.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cronos_lerobot.agents.base import ActionSample, Agent
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import Event, LoopState, Step, Update
from cronos_lerobot.protocol.resets import Resets
from cronos_lerobot.protocol.streams import Streams, Task
from cronos_lerobot.protocol.task_orders import TaskOrder


def rf_mtrl(
    env: Streams,
    tasks: Sequence[Task],  # 1
    agent: Agent,  # 1
    task_order: TaskOrder,
    resets: Resets,  # 3, 4
    protocol: ProtocolConfig,  # 2
    loop: LoopState,
    total_steps: int,  # 2
) -> Iterator[Event]:
    """Train `agent` on the streams of `env`; `loop` says where to begin and always where the run stands.

    Yields a Step after every control step, an Update after every policy update, and a SegmentEnd once the
    resets of a task switch are done: there, and only there, the run may be saved and continued later.
    """
    K, U = protocol.task_switch_interval, protocol.update_interval
    B = float("inf") if protocol.reset_budget is None else protocol.reset_budget
    streams = np.arange(loop.num_streams)

    resets.initial.apply_if_due(env, loop)  # 5, 6
    while loop.n < total_steps and loop.b < B:  # 7
        loop.switch_task(task_order.draw(loop))  # 8
        env.set_task(streams, [tasks[i] for i in loop.task])
        tau = [tasks[i].instruction for i in loop.task]
        o_t = env.observe()  # 10
        for k in range(1, K + 1):  # 9
            a_t = agent.act(o_t, tau)  # 11
            o_tp1, r_t, _, _, info = env.step(a_t.action)  # 12
            a_t = _executed(a_t, info)
            loop.count_help(a_t.intervened)
            # A trace ends where the next frame is not the outcome of this action under this instruction.
            cut_t = info["diverged"] | (k == K)
            agent.store(o_t, tau, a_t, r_t, o_tp1, cut_t, info["diverged"])  # 13
            step_t = _describe(loop, o_t, tau, a_t, r_t, cut_t, info)
            loop.count_step(info, cut_t)  # 14
            yield step_t
            if loop.t % U == 0:  # 15
                metrics = agent.update()  # 16, 17, 18
                loop.updates += 1
                yield Update(metrics)
            if k < K and resets.divergence.apply_if_due(env, loop):
                o_tp1 = env.observe()
            o_t = o_tp1
        segment = loop.end_segment()
        # Only now: what diverged in the last step belongs to the scene that it was in.
        resets.divergence.apply_if_due(env, loop)
        resets.end_effector.apply_if_due(env, loop)  # 21, 22
        resets.heuristic.apply_if_due(env, loop)  # 23, 24
        for strategy in resets.extra:
            strategy.apply_if_due(env, loop)
        resets.scene.apply_if_due(env, loop)  # 25, 26
        yield segment


def _executed(a_t: ActionSample, info: dict[str, Any]) -> ActionSample:
    """What was done instead of what was chosen, and who was helped, as far as the environment says it."""
    return replace(a_t, action=info.get("executed_action", a_t.action), intervened=info.get("intervened"))


def _describe(
    loop: LoopState, o_t: Any, tau: list[str], a_t: Any, r_t: np.ndarray, cut_t: np.ndarray, info: dict
) -> Step:
    return Step(
        t=loop.t,
        observation=o_t,
        instructions=tau,
        action=a_t,
        reward=r_t,
        success=info["is_success"],
        diverged=info["diverged"],
        cut=cut_t,
        piece=loop.piece.copy(),
        segments_since_reset=loop.segments_since_reset.copy(),
        preceded_by=loop.preceded_by,
        interventions=loop.stream_interventions,
        policy_version=loop.updates,
        intervened=loop.intervened,
    )
