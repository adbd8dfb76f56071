"""Weighted imitation of two processes, which is that of all that both remember."""

from dataclasses import replace

import numpy as np
import pytest
from forked_processes import together
from test_imitation import settings, train, update_once

from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.ranks import Ranks


def weighted(folder, weighting, beta):
    algorithm = ImitationConfig(
        steps_per_update=5, batch_size=8, warmup_segments=3, tail_steps=1, weighting=weighting, weighting_beta=beta
    )
    return settings(folder, algorithm=algorithm)


def update_own(ranks, cfg, memories):
    return update_once(ranks, cfg, memories[ranks.rank], ranks.rank)


def remembered(folder):
    """Of a run, what succeeded and what failed."""
    segments = train(weighted(folder, "return", 0.2)).run.agent.memory.state_dict()
    parts = [[segment for segment in segments if segment["success"] is one] for one in (True, False)]
    assert min(map(len, parts)) >= 3
    return parts


def test_a_process_that_has_only_failed_clones_next_to_nothing_of_it(tmp_path):
    """Its largest return is not the largest: exp(-0.3 / 0.01) and less of a success's weight is its own."""
    won, lost = remembered(tmp_path / "run")
    for segment in won:
        segment["columns"]["next.reward"][-1] = 1
    for segment in lost:
        segment["columns"]["next.reward"][:] = 0
    cfg = replace(weighted(tmp_path / "run", "return", 0.01), output_dir=tmp_path / "other")
    alone = update_once(Ranks(), cfg, won)
    assert alone[0]["optimizer_steps"] == 5
    first, second = together(update_own, cfg, [won, lost])
    assert first[1:] == second[1:]
    assert first[0] == second[0]
    assert first[0]["failed_segments"] == len(lost)
    # The loss that is logged is the one that is learned from.
    assert first[0]["loss"] == pytest.approx(alone[0]["loss"], rel=1e-4)
    for found, expected in zip(first[1:], alone[1:], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("weighting", ["return", "advantage"])
def test_the_effective_share_is_that_of_one_process_with_all_of_it(tmp_path, weighting):
    won, lost = remembered(tmp_path / "run")
    cfg = replace(weighted(tmp_path / "run", weighting, 0.2), output_dir=tmp_path / "other")
    alone = update_once(Ranks(), cfg, [*won, *lost])[0]
    first, second = together(update_own, cfg, [won, lost])
    assert 0 < alone["effective_share"] < 1
    for found in (first[0], second[0]):
        assert found["effective_share"] == pytest.approx(alone["effective_share"])
