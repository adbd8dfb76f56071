"""Scenes from outside the package: registered, drawn, written as benchmarks, and what is refused."""

import json
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from env_rollouts import STATE, make, run_expert
from lerobot_env_cronos import SCENES, Body, CronosEnvConfig, Scene, register_scene
from lerobot_env_cronos.benchmark import configurations
from lerobot_env_cronos.benchmark.benchmark import describe_bodies, draw_benchmark, packaged_benchmark
from lerobot_env_cronos.benchmark.configurations import (
    load_configurations,
    write_configurations,
)
from lerobot_env_cronos.benchmark.files import (
    BODIES_KEY,
    BenchmarkError,
    read_benchmark,
    write_benchmark,
)
from lerobot_env_cronos.benchmark.poses import find_overlaps
from lerobot_env_cronos.expert.reach import sample_reach_configuration
from lerobot_env_cronos.scene.bodies import SHAPES, describe_collisions
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.scene.visuals.objects import LOOKS

pytestmark = pytest.mark.usefixtures("registries")
BLOCK = Body("red block", (0.03, 0.03, 0.03), 600, "box", (0.8, 0.1, 0.1))
COASTER = Body("blue coaster", (0.09, 0.09, 0.005), 900, "disc", (0.1, 0.3, 0.8))
SCENE = Scene("study", ("red block", "ketchup bottle"), ("blue coaster",))
TRAIN = "configurations/train.parquet"


@pytest.fixture
def study(tmp_path):
    """A benchmark of your own scene, and its folder."""
    register_scene(SCENE, bodies=[BLOCK, COASTER])
    benchmark = draw_benchmark("study", seed=1, num_configurations=2, num_orderings=2)
    write_benchmark(benchmark, tmp_path)
    return benchmark, tmp_path


# Registering ---------------------------------------------------------------------------------------------


def test_a_registered_scene_is_usable_by_name():
    register_scene(SCENE, bodies=[BLOCK, COASTER])
    envs = CronosEnvConfig(scene="study", obs_type=STATE).create_envs(2)["independent_train"]
    assert envs[1].reset(seed=[3, 4])[0]["environment_state"].shape == (2, 36)
    assert envs[1].call("task_description") == ("put the ketchup bottle on the blue coaster",) * 2
    env = gym.make("lerobot_env_cronos/study-v1", obs_type=STATE, task="put the red block on the blue coaster")
    assert env.reset(seed=0)[1]["task"] == 0
    before = dict(SCENES), dict(BODIES)
    register_scene(SCENE, bodies=[BLOCK, COASTER])
    assert before == (SCENES, BODIES)


def test_plain_bodies_have_mass_and_colour_and_can_be_placed():
    register_scene(SCENE, bodies=[BLOCK, COASTER])
    env = make(8, "study")
    model = env.simulation.render_model
    assert model.body("red block").mass[0] == pytest.approx(0.03**3 * 600)
    assert model.body("blue coaster").mass[0] == pytest.approx(np.pi * 0.045**2 * 0.005 * 900)
    material = model.geom("red block visual").matid[0]
    np.testing.assert_allclose(model.mat_rgba[material], [0.8, 0.1, 0.1, 1.0], atol=1e-6)
    env.set_task(np.arange(8), [SCENE.tasks[0]] * 8)
    assert run_expert(env).mean() >= 0.9


@pytest.mark.parametrize(
    ("scene", "bodies", "named"),
    [
        (Scene("kitchen_2x2", ("red block",), ("blue coaster",)), [BLOCK, COASTER], "kitchen_2x2"),
        (Scene("My-scene", ("red block",), ("blue coaster",)), [BLOCK, COASTER], "My-scene"),
        (SCENE, [BLOCK], "blue coaster"),
        (SCENE, [BLOCK, Body("blue coaster", (0.1, 0.1, 0.01), 1, "ring")], "ring"),
        (SCENE, [BLOCK, replace(COASTER, size=(0.09, 0.08, 0.005))], "blue coaster"),
        (Scene("study", ("red block",), ()), [BLOCK], "receptacles"),
        # MuJoCo drops the second joint of a name without a word.
        (SCENE, [replace(BLOCK, name="elbow"), COASTER], "elbow"),
        (replace(SCENE, spawn_low=(0.45, -0.1), spawn_high=(0.6, 0.1)), [BLOCK, COASTER], "spawn"),
        # The camera does not see it everywhere.
        (replace(SCENE, spawn_low=(0.2, -0.25)), [BLOCK, COASTER], "spawn"),
        (SCENE, [replace(BLOCK, size=(0.06, 0.05, 0.05)), COASTER], "50 mm"),
        # Columns of datasets would have one name.
        (
            replace(SCENE, objects=("red block", "red_block")),
            [BLOCK, COASTER, replace(BLOCK, name="red_block")],
            "red_block",
        ),
        (SCENE, [replace(BLOCK, name="red/block"), COASTER], "red/block"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_registered(scene, bodies, named):
    before = dict(SCENES), dict(BODIES)
    with pytest.raises(ValueError, match=named):
        register_scene(scene, bodies=bodies)
    assert before == (SCENES, BODIES)


# Configurations ------------------------------------------------------------------------------------------


def test_configurations_from_a_file_are_checked_row_by_row(tmp_path):
    register_scene(SCENE, bodies=[BLOCK, COASTER])
    path = write_configurations("study", tmp_path, seed=7)
    content = json.loads(path.read_text())
    fresh = {"bodies": [BLOCK, COASTER], "configurations": path}
    del SCENES["study"], BODIES["red block"], BODIES["blue coaster"]
    del gym.registry["lerobot_env_cronos/study-v1"]
    good = content["splits"]["held_out"][5][0]
    for pose in ([0.9, *good[1:]], [*good[:3], 2.0, *good[4:]], [None, *good[1:]]):
        content["splits"]["held_out"][5][0] = pose
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=r"held_out of .*row 5: the red block"):
            register_scene(SCENE, **fresh)
        assert not {"study", "red block"} & (SCENES.keys() | BODIES.keys())
    content["splits"]["held_out"][5][0] = good
    path.write_text(json.dumps(content))
    register_scene(SCENE, **fresh)
    np.testing.assert_allclose(load_configurations("study", "held_out")[5, 0], good)
    # It keeps them.
    (tmp_path / "others").mkdir()
    for scene in (SCENE, SCENES["kitchen_2x2"]):
        with pytest.raises(ValueError, match=scene.name):
            register_scene(scene, configurations=write_configurations(scene.name, tmp_path / "others", seed=8))


def test_bodies_that_do_not_fit_or_hardly_ever_are_an_error(monkeypatch):
    """Of the second one about one layout in ten can be completed: all 128 would take minutes, mostly in vain."""
    tries = []
    monkeypatch.setattr(configurations, "MAX_ATTEMPTS", 500)
    place = configurations._try_configuration
    monkeypatch.setattr(configurations, "_try_configuration", lambda *scene: tries.append(1) or place(*scene))
    small = {"spawn_low": (0.3, 0.0), "spawn_high": (0.32, 0.02)}
    register_scene(Scene("small", ("ketchup bottle",), ("yellow plate", "cloth"), **small))
    objects = ("ketchup bottle", "kitchen shovel", "toy bear", "plastic bottle")
    register_scene(Scene("crowded", objects, ("yellow plate", "cloth", "carpet", "newspaper")))
    for name in ("small", "crowded"):
        with pytest.raises(ValueError, match=f"{name}: . bodies do not fit"):
            load_configurations(name, "train")
    assert len(tries) <= 60


@pytest.mark.parametrize("draw", [packaged_benchmark, lambda name: draw_benchmark(name, 1, 30, 1)])
def test_bodies_as_tall_as_the_hand_is_high_are_drawn_beside_it(draw):
    """The fingertips end 105 mm above the table."""
    carton = Body("carton", (0.04, 0.09, 0.12), 150, "box")
    register_scene(Scene("tall", ("carton", "ketchup bottle"), ("yellow plate",)), bodies=[carton])
    benchmark = draw("tall")
    for poses in benchmark.configurations.values():
        assert set(find_overlaps(benchmark.scene, poses)) == {None}
    # A plain drawing puts some of them into the hand.
    drawn, rng = [], np.random.default_rng(1)
    while len(drawn) < 60:
        if (poses := configurations._try_configuration(benchmark.scene, rng)) is not None:
            drawn.append(poses)
    assert any(why and "carton" in why for why in find_overlaps(benchmark.scene, np.stack(drawn)))


def test_an_object_that_is_carried_nowhere_is_told():
    register_scene(Scene("towers", ("tower",), ("cloth",)), bodies=[Body("tower", (0.03, 0.03, 0.3), 100, "box")])
    with pytest.raises(ValueError, match="tower"):
        sample_reach_configuration(SCENES["towers"], np.random.default_rng(0))


# What bodies a benchmark is of ---------------------------------------------------------------------------


def test_a_benchmark_of_other_bodies_is_refused(study, monkeypatch):
    benchmark, folder = study
    fingerprints = {benchmark.fingerprint}
    for field, value in (("density", 300), ("size", (0.03, 0.03, 0.04))):
        monkeypatch.setitem(BODIES, "red block", replace(BLOCK, **{field: value}))
        fingerprints.add(benchmark.fingerprint)
        with pytest.raises(BenchmarkError, match=f"{field} of the red block"):
            read_benchmark(folder, "me/study@abc")
    assert len(fingerprints) == 3


def test_a_benchmark_that_does_not_say_its_bodies_loads(study, monkeypatch):
    """As `datasets` writes it; one whose poses were edited is of the same bodies."""
    benchmark, folder = study
    table = pq.read_table(folder / TRAIN)
    moved = table.to_pylist()
    moved[0]["red_block_z_m"] += 0.001
    pq.write_table(pa.Table.from_pylist(moved, schema=table.schema), folder / TRAIN)
    assert read_benchmark(folder, "it").fingerprint != benchmark.fingerprint
    for split in ("train", "held_out"):
        path = folder / f"configurations/{split}.parquet"
        pq.write_table(pq.read_table(path).replace_schema_metadata({"huggingface": "{}"}), path)
    monkeypatch.setitem(BODIES, "red block", replace(BLOCK, density=300))
    read_benchmark(folder, "it")


@pytest.mark.parametrize("text", ["eraser", "5", '["eraser"]', '[{"size": 1}]', "reversed"])
def test_bodies_that_are_not_those_of_the_scene(study, text):
    benchmark, folder = study
    if text == "reversed":
        text = json.dumps(describe_bodies(benchmark.scene)[::-1])
    pq.write_table(pq.read_table(folder / TRAIN).replace_schema_metadata({BODIES_KEY: text}), folder / TRAIN)
    with pytest.raises(BenchmarkError, match="configurations/train"):
        read_benchmark(folder, "it")


def peg(half_width, friction=1.0):
    """A builder of a foot of 40 x 40 x 20 mm that bears a square peg, 30 mm high."""

    def add(spec_body, body):
        for half, z in (((0.02, 0.02, 0.01), -0.015), ((half_width, half_width, 0.015), 0.01)):
            spec_body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=(0, 0, z), density=body.density,
                friction=[friction, 0.01, 0.003],
            )  # fmt: skip

    return add


def test_the_fingerprint_sees_what_your_own_shape_collides_with(monkeypatch):
    body = Body("peg", (0.04, 0.04, 0.05), 500, "peg")
    monkeypatch.setitem(LOOKS, "peg", lambda *args: LOOKS["box"](*args))
    monkeypatch.setitem(SHAPES, "peg", peg(0.005))
    register_scene(Scene("pegs", ("peg",), ("cloth",)), bodies=[body])
    benchmark = draw_benchmark("pegs", seed=1, num_configurations=1, num_orderings=1)
    described = describe_collisions(body)
    # 500 kg/m^3 of 40 x 40 x 20 mm and of 10 x 10 x 30 mm.
    assert described["mass"] == pytest.approx(500 * (32e-6 + 3e-6))
    assert [geom["size"] for geom in described["geoms"]] == [[0.02, 0.02, 0.01], [0.005, 0.005, 0.015]]
    fingerprints = {benchmark.fingerprint}
    for other in (peg(0.006), peg(0.005, friction=0.5), SHAPES["box"]):
        monkeypatch.setitem(SHAPES, "peg", other)
        fingerprints.add(benchmark.fingerprint)
    assert len(fingerprints) == 4
