"""Benchmarks of scenes of one's own: what they are of, how their configurations are drawn, and what is refused."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot_env_cronos import SCENES, Body, Scene, register_scene
from lerobot_env_cronos.benchmark import configurations
from lerobot_env_cronos.benchmark.benchmark import describe_bodies, draw_benchmark, packaged_benchmark
from lerobot_env_cronos.benchmark.configurations import redraw_shared, sample_configurations
from lerobot_env_cronos.benchmark.files import (
    BODIES_KEY,
    BenchmarkError,
    check_tag,
    read_benchmark,
    write_benchmark,
)
from lerobot_env_cronos.benchmark.poses import find_overlaps
from lerobot_env_cronos.expert.reach import sample_reach_configuration
from lerobot_env_cronos.scene.bodies import SHAPES, describe_collisions
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.scene.visuals.objects import LOOKS

pytestmark = pytest.mark.usefixtures("registries")
ERASER = Body("eraser", (0.03, 0.06, 0.02), 600, "box")
COASTER = Body("coaster", (0.1, 0.1, 0.005), 900, "disc")
TRAIN = "configurations/train.parquet"


@pytest.fixture
def study(tmp_path):
    """A benchmark of a scene of one's own, and its folder."""
    register_scene(Scene("study", ("eraser", "ketchup bottle"), ("coaster",)), bodies=[ERASER, COASTER])
    benchmark = draw_benchmark("study", seed=1, num_configurations=2, num_orderings=2)
    write_benchmark(benchmark, tmp_path)
    return benchmark, tmp_path


# What bodies a benchmark is of ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"density": 300}, "density of the eraser is 300 here and 600 there$"),
        # The poses of the other one stand in the table, too.
        (
            {"size": (0.03, 0.06, 0.04)},
            r"size of the eraser is \[0.03, 0.06, 0.04\] here and \[0.03, 0.06, 0.02\] t",
        ),
        (
            {"size": (0.03, 0.07, 0.02), "shape": "bottle"},
            "shape of the eraser is bottle here and box there; size of",
        ),
    ],
)
def test_a_benchmark_of_other_bodies_is_refused(study, monkeypatch, changes, difference):
    benchmark, folder = study
    there = benchmark.fingerprint
    monkeypatch.setitem(BODIES, "eraser", replace(ERASER, **changes))
    here = benchmark.fingerprint
    assert here != there
    message = (
        f"me/study@abc, configurations/train: its fingerprint is {there} with .* and {here} with .* {difference}"
    )
    with pytest.raises(BenchmarkError, match=message):
        read_benchmark(folder, "me/study@abc")


def test_a_benchmark_that_does_not_say_its_bodies_loads(study, monkeypatch):
    """As those that were published before; and one whose poses were edited is of the same bodies."""
    benchmark, folder = study
    table = pq.read_table(folder / TRAIN)
    moved = table.to_pylist()
    moved[0]["eraser_z_m"] += 0.001
    pq.write_table(pa.Table.from_pylist(moved, schema=table.schema), folder / TRAIN)
    assert read_benchmark(folder, "it").fingerprint != benchmark.fingerprint
    for split in ("train", "held_out"):
        path = folder / f"configurations/{split}.parquet"
        pq.write_table(pq.read_table(path).replace_schema_metadata({"huggingface": "{}"}), path)
    monkeypatch.setitem(BODIES, "eraser", replace(ERASER, density=300))
    read_benchmark(folder, "it")


@pytest.mark.parametrize("text", ["eraser", "5", '["eraser"]', '[{"size": 1}]'])
def test_bodies_that_cannot_be_read(study, text):
    _, folder = study
    pq.write_table(pq.read_table(folder / TRAIN).replace_schema_metadata({BODIES_KEY: text}), folder / TRAIN)
    with pytest.raises(
        BenchmarkError, match=r"configurations/train: lerobot_env_cronos.bodies must be a JSON list"
    ):
        read_benchmark(folder, "it")


def test_bodies_in_another_order_are_another_benchmark(study):
    benchmark, folder = study
    bodies = describe_bodies(benchmark.scene)[::-1]
    metadata = {BODIES_KEY: json.dumps(bodies)}
    pq.write_table(pq.read_table(folder / TRAIN).replace_schema_metadata(metadata), folder / TRAIN)
    with pytest.raises(BenchmarkError, match=r"here and \['coaster', 'ketchup bottle', 'eraser'\] there$"):
        read_benchmark(folder, "it")


def test_files_are_the_same_every_time(study, tmp_path):
    benchmark, folder = study
    write_benchmark(benchmark, tmp_path / "again")
    assert (tmp_path / "again" / TRAIN).read_bytes() == (folder / TRAIN).read_bytes()


def test_a_revision_that_names_a_fingerprint_has_it(study):
    benchmark, _ = study
    for revision in ("", "@main", "@benchmark-mine", f"@benchmark-{benchmark.fingerprint}"):
        assert check_tag(benchmark, f"me/study{revision}") is benchmark
    with pytest.raises(
        BenchmarkError, match=f"{benchmark.fingerprint} here, not 0123456789abcdef: its scene study "
    ):
        check_tag(benchmark, "me/study@benchmark-0123456789abcdef")


def peg(half_width, friction=1.0):
    """A builder of a foot of 40 x 40 x 20 mm that bears a square peg, 30 mm high."""

    def add(spec_body, body):
        for half, z in (((0.02, 0.02, 0.01), -0.015), ((half_width, half_width, 0.015), 0.01)):
            spec_body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=(0, 0, z), density=body.density,
                friction=[friction, 0.01, 0.003],
            )  # fmt: skip

    return add


def test_the_fingerprint_sees_what_a_shape_of_ones_own_collides_with(monkeypatch):
    body = Body("peg", (0.04, 0.04, 0.05), 500, "peg")
    monkeypatch.setitem(LOOKS, "peg", lambda *args: LOOKS["box"](*args))
    monkeypatch.setitem(SHAPES, "peg", peg(0.005))
    register_scene(Scene("pegs", ("peg",), ("cloth",)), bodies=[body])
    benchmark = draw_benchmark("pegs", seed=1, num_configurations=1, num_orderings=1)
    described = describe_collisions(body)
    # 500 kg/m^3 of 40 x 40 x 20 mm and of 10 x 10 x 30 mm.
    assert described["mass"] == pytest.approx(500 * (32e-6 + 3e-6))
    assert [geom["size"] for geom in described["geoms"]] == [[0.02, 0.02, 0.01], [0.005, 0.005, 0.015]]
    assert [geom["pos"][2] for geom in described["geoms"]] == [-0.015, 0.01]
    fingerprints = {benchmark.fingerprint}
    for other in (peg(0.006), peg(0.005, friction=0.5), SHAPES["box"]):
        monkeypatch.setitem(SHAPES, "peg", other)
        fingerprints.add(benchmark.fingerprint)
    assert len(fingerprints) == 4
    monkeypatch.setitem(SHAPES, "peg", peg(0.005))
    assert benchmark.fingerprint in fingerprints
    assert describe_bodies(benchmark.scene)[1].keys() == {"name", "size", "density", "shape", "colour"}


@pytest.mark.parametrize(
    ("given", "plain"),
    [
        (ERASER, ERASER),
        (Body("e", np.array([0.5, 0.25, 0.125]), np.int64(600), "box"), Body("e", (0.5, 0.25, 0.125), 600, "box")),
        (
            Body("e", [np.float32(0.5), 1, np.float64(0.125)], np.float32(600), "box", np.float32([0.5, 0, 1])),
            Body("e", (0.5, 1, 0.125), 600.0, "box", (0.5, 0.0, 1.0)),
        ),
    ],
)
def test_bodies_have_numbers_of_python(given, plain):
    """As JSON writes them, which tells 600 from 600.0."""
    assert json.dumps([given.size, given.density, given.colour]) == json.dumps(
        [plain.size, plain.density, plain.colour]
    )
    assert given == plain
    assert hash(given) == hash(plain)


def test_a_body_of_numpy_numbers_has_a_fingerprint():
    size = tuple(np.array([30, 60, 20], dtype=np.float32) / 1000)
    register_scene(Scene("numbers", ("eraser",), ("cloth",)), bodies=[Body("eraser", size, 600, "box")])
    assert len(draw_benchmark("numbers", 1, 1, 1).fingerprint) == 16


# What is drawn -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("draw", [packaged_benchmark, lambda name: draw_benchmark(name, 1, 30, 1)])
def test_bodies_as_tall_as_the_hand_is_high_are_drawn_beside_it(draw, tmp_path):
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
    write_benchmark(benchmark, tmp_path)
    assert read_benchmark(tmp_path, "it").fingerprint == benchmark.fingerprint


def test_bodies_that_leave_no_room_for_the_hand_are_told():
    low, high = (0.27, -0.03), (0.33, 0.03)
    scene = Scene("under_the_hand", ("carton",), ("saucer",), spawn_low=low, spawn_high=high)
    carton, saucer = (
        Body("carton", (0.04, 0.04, 0.2), 150, "box"),
        Body("saucer", (0.02, 0.02, 0.005), 900, "disc"),
    )
    register_scene(scene, bodies=[carton, saucer])
    with pytest.raises(
        ValueError, match=r"do not fit into .* clear of the arm at home \(the carton stands .* deep in"
    ):
        sample_configurations(scene, 20, np.random.default_rng(0))


def test_held_out_configurations_that_are_training_ones_are_drawn_again():
    scene, rng = SCENES["playroom_2x2"], np.random.default_rng(0)
    train = sample_configurations(scene, 4, rng)
    drawn = sample_configurations(scene, 3, rng)
    held_out = drawn.copy()
    held_out[1] = train[2]
    again = redraw_shared(scene, held_out, train, rng)
    np.testing.assert_array_equal(again[[0, 2]], drawn[[0, 2]])
    assert np.abs(again[1] - train).max(axis=(1, 2)).min() > 0.01
    np.testing.assert_array_equal(held_out[1], train[2])


def test_an_object_that_is_carried_nowhere_is_told():
    register_scene(Scene("towers", ("tower",), ("cloth",)), bodies=[Body("tower", (0.03, 0.03, 0.3), 100, "box")])
    with pytest.raises(ValueError, match=r"^nothing is within reach in towers: .* carry the tower, 0\.3 m tall$"):
        sample_reach_configuration(SCENES["towers"], np.random.default_rng(0))
