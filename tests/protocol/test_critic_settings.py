"""Which settings of values that choose are taken, and which are refused and how."""

import math

import pytest
from test_rf_mtrl import protocol

from cronos_lerobot.protocol.config import CriticConfig


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reset_phase": "scattered"}, "reset_phase must be one of"),
        ({"reset_phase": "staggered", "scene_reset_interval": 2}, "there is none between them with .*=2: leave"),
        ({"reset_phase": "staggered", "scene_reset_interval": None}, "between them with .*=None: leave it out"),
        ({"scene_reset": "never"}, "scene_reset must be one of"),
        ({"scene_reset": "critic"}, "give protocol.reset_budget"),
        ({"scene_reset": "critic", "reset_budget": 5, "reset_phase": "staggered"}, "leave them out"),
        ({"scene_reset": "critic", "reset_budget": 5, "curriculum": [(8, 4)]}, "leave them out"),
        (
            {"scene_reset": "critic", "reset_budget": 5, "scene_reset_interval": 8},
            "=8 is for periodic .* or give null",
        ),
        (
            {"critic": CriticConfig(failures=3)},
            "protocol.critic.failures=3 is read by protocol.scene_reset=critic alone",
        ),
        (
            {"critic": CriticConfig(failures=3), "task_order": "critic"},
            "read by protocol.scene_reset=critic alone",
        ),
        (
            {"critic": CriticConfig(floor=0.5), "scene_reset": "critic", "reset_budget": 5},
            "floor=0.5 is read by protocol.task_order=critic alone: give that, or leave it at 0.02",
        ),
        (
            {"critic": CriticConfig(knows_complete=False)},
            "knows_complete=false is read by protocol.task_order=critic or protocol.scene_reset=critic alone",
        ),
    ],
)
def test_protocols_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        protocol(**options)


@pytest.mark.parametrize(
    ("name", "value", "options"),
    [
        ("certain_value", 3, {"task_order": "critic"}),
        ("failures", 3, {"scene_reset": "critic", "reset_budget": 5, "scene_reset_interval": None}),
        ("knows_complete", False, {"scene_reset": "critic", "reset_budget": 5, "scene_reset_interval": None}),
        # A user's may go by values, too.
        ("certain_value", 3, {"task_order": "of_a_user"}),
        ("failures", 3, {"extra_resets": ["of_a_user"]}),
    ],
)
def test_critics_settings_are_taken_where_something_may_read_them(name, value, options):
    assert getattr(protocol(critic=CriticConfig(**{name: value}), **options).critic, name) == value


@pytest.mark.parametrize(
    "options",
    [
        {"certain_value": 0}, {"floor": 0}, {"sharpness": -1}, {"failures": 0}, {"failures": 17},
        {"certain_value": math.nan}, {"certain_value": math.inf}, {"floor": math.nan}, {"sharpness": math.nan},
    ],
)  # fmt: skip
def test_critics_settings_out_of_range_are_named(options):
    with pytest.raises(ValueError, match=f"protocol.critic.{next(iter(options))} must be"):
        CriticConfig(**options)
