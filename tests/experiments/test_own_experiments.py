"""Experiments of one's own: what their fields may be is told when they are declared, not after their runs."""

import pytest
from lerobot.utils import import_utils
from lerobot_env_cronos.benchmark.benchmark import SUITES
from lerobot_env_cronos.benchmark.configurations import SPLITS
from lerobot_env_cronos.scene.scenes import SCENES, Scene

from cronos_lerobot.experiments import definitions
from cronos_lerobot.experiments.definitions import CheckpointEvaluation, Experiment, Row
from cronos_lerobot.experiments.scales import PIXELS, SCALES, STATE, base_recipe

BOTH = ("train", "held_out")
CHAINS = CheckpointEvaluation("sequential", BOTH)


def own_experiment(rows=None, **fields):
    return Experiment("mine", "", (Row(80), Row(320)) if rows is None else rows, **fields)


@pytest.mark.parametrize(
    ("suite", "splits", "message"),
    [
        ("sequentiel", BOTH, r"suite .* must be one of \['independent', 'sequential'\], got 'sequentiel'"),
        # A comma is missing: a job for each letter.
        (
            "sequential",
            ("held_out"),
            r"splits of the sequential .* a tuple, such as \('held_out',\), got 'held_out'",
        ),
        (
            "independent",
            ("train", "heldout"),
            r"must be some of \['train', 'held_out'\], got \('train', 'heldout'\)",
        ),
        ("independent", (), r"must be some of \['train', 'held_out'\], got \(\)"),
    ],
)
def test_evaluations_that_there_are_not(suite, splits, message):
    with pytest.raises(ValueError, match=message):
        CheckpointEvaluation(suite, splits)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"axes": ("interactions",)},
            r"axes of mine must be some of \['interaction_steps', 'interventions'\], got \('interactions',\)",
        ),
        ({"axes": ()}, r"axes of mine must be some of .*, got \(\)"),
        ({"splits": ("heldout",)}, r"splits of mine must be some of .*, got \('heldout',\)"),
        ({"splits": "train"}, r"splits of mine must be a tuple, such as \('train',\), got 'train'"),
        ({"rows": Row(80)}, r"rows of mine must be a tuple, such as \(Row\(interval=80"),
        ({"evaluations": CHAINS}, r"evaluations of mine must be a tuple, such as \(CheckpointEvaluation\("),
        ({"budgets": 1000}, r"budgets of mine must be a tuple, such as \(1000,\), got 1000"),
        ({"steps": 500_000}, "steps of mine must be SHORT=1300000 or LONG=2900000, got 500000"),
        (
            {"joined": (("a", ("t80", "t81")),)},
            r"joined 'a' of mine must be some of \['t80', 't320'\], got \('t80', 't81'\)",
        ),
        ({"joined": (("a", ("t80")),)}, r"joined 'a' of mine must be a tuple, such as \('t80',\), got 't80'"),
        ({"joined": ("a", ("t80",))}, r"joined of mine are pairs, \(label, names of rows\), got 'a'"),
        (
            {"splits": BOTH, "evaluations": (CHAINS,)},
            r"splits of mine have 'held_out', .*: give .*CheckpointEvaluation\('independent', \('held_out',\)",
        ),
    ],
)
def test_fields_that_mean_nothing(fields, message):
    with pytest.raises(ValueError, match=message):
        own_experiment(**fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"stages": (10_000, 80)}, "stages of a row are pairs, .*, got 10000"),
        ({"budgets": ("--protocol.reset_budget", 9)}, "budgets of a row are pairs, .*, got '--protocol.reset_b"),
    ],
)
def test_a_comma_that_is_missing_in_a_row(fields, message):
    with pytest.raises(ValueError, match=message):
        Row(80, tag="mine", **fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"flags": ("--steps=600000",)}, "--steps=600000 is set by the experiment"),
        ({"flags": ("--protocol.update_interval=320",)}, "update_interval=320 is set by the experiment"),
        ({"flags": ("--policy.path=me/other",)}, "--policy.path=me/other is set by the experiment"),
        ({"flags": ("--eval.temperature=1",)}, "--eval.temperature=1 is set by the experiment"),
        ({"tag": "v2: x"}, "the tag of a row is part of a folder's name, one word .*, got 'v2: x'"),
        ({"tag": "a/b"}, "got 'a/b'"),
        ({"num_configurations": 0}, "num_configurations of a row must be at least 1, got 0"),
    ],
)
def test_rows_whose_runs_would_not_be_where_or_what_they_are_said_to_be(fields, message):
    with pytest.raises(ValueError, match=message):
        Row(80, **{"tag": "mine"} | fields)


def test_names_and_checkpoints_of_an_experiment():
    with pytest.raises(ValueError, match=r"name of an experiment is part of a folder's name, .*, got 'my/table'"):
        Experiment("my/table", "", (Row(80),))
    rows = (Row(80, tag="few", flags=("--keep_checkpoints=1",)),)
    own_experiment(rows)
    with pytest.raises(ValueError, match="mine: --keep_checkpoints=1 of t80_few drops checkpoints"):
        own_experiment(rows, evaluations=(CHAINS,))


def test_lists_will_do():
    evaluation = CheckpointEvaluation("independent", ["held_out"])
    own_experiment([Row(80)], splits=["train", "held_out"], evaluations=[evaluation], joined=[["a", ["t80"]]])


def test_where_held_out_curves_come_from():
    both = {"splits": BOTH}
    for every_checkpoint in (True, False):
        evaluation = CheckpointEvaluation("independent", ("held_out",), every_checkpoint)
        own_experiment(**both, evaluations=(evaluation,))
    # A row whose runs are evaluated there while they train has its curve from them.
    own_experiment((Row(80), Row(80, tag="held", flags=("--eval.split=held_out",))), **both)


def test_suites_and_splits_are_the_environments():
    assert (definitions.SUITES, definitions.BOTH) == (SUITES, SPLITS)


def test_an_unknown_base_is_named():
    with pytest.raises(ValueError, match=r"one of \['narrow', 'wide', 'wide_resets'\], got 'wid'"):
        base_recipe(SCALES["small"], "kitchen_2x2", STATE, kind="wid")


def test_a_scene_of_ones_own_has_as_much_for_each_task(monkeypatch):
    """kitchen_2x2 has 100 demonstrations and 80 gradient steps of 320 for each of its four tasks."""
    scene = Scene("desk_1x2", objects=("toy bear",), receptacles=("cloth", "carpet"))
    monkeypatch.setitem(SCENES, scene.name, scene)
    recipe = base_recipe(SCALES["small"], "desk_1x2", STATE)
    assert (recipe.demos, recipe.clone_steps, recipe.checkpoint) == (200, 160, 160)
    # That from clean demonstrations is taken after three quarters of its steps.
    recipe = base_recipe(SCALES["paper"], "desk_1x2", STATE, clean=True)
    assert (recipe.demos, recipe.clone_steps, recipe.checkpoint, recipe.clean) == (200, 320, 240, True)
    recipe = base_recipe(SCALES["small"], "desk_1x2", PIXELS, kind="wide_resets")
    assert (recipe.demos, recipe.clone_steps, recipe.kind) == (1600, 1200, "wide_resets")
    with pytest.raises(ValueError, match="unknown scene 'nowhere'"):
        base_recipe(SCALES["small"], "nowhere", STATE)


def test_the_scene_of_an_installed_package_is_known(monkeypatch):
    """Its import registers it, which nothing has asked for when an experiment is planned or reported."""
    scene = Scene("desk_2x2", objects=("toy bear", "plastic bottle"), receptacles=("cloth", "carpet"))
    monkeypatch.setattr(
        import_utils, "register_third_party_plugins", lambda: monkeypatch.setitem(SCENES, scene.name, scene)
    )
    assert base_recipe(SCALES["small"], "desk_2x2", STATE).demos == 400
