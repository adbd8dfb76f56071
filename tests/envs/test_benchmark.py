"""Benchmarks of one's own: files, their checks, and the environments that run them."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv, get_scene, load_benchmark
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark, packaged_benchmark
from lerobot_env_cronos.benchmark.configurations import SEED, SPLITS, load_configurations
from lerobot_env_cronos.benchmark.files import BenchmarkError, read_benchmark, write_benchmark

STATE = "environment_state_agent_pos"
# A change of these is another benchmark: a new version of the environment id.
FINGERPRINTS = {
    "kitchen_2x2": "b6d16e60c5a22994",
    "kitchen_3x3": "2d9849b1ee7b468c",
    "playroom_2x2": "202ac0fadb48980b",
}


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """A benchmark of 3 configurations and 2 chains of 3 tasks, in a folder."""
    folder = tmp_path_factory.mktemp("mine")
    benchmark = draw_benchmark("playroom_2x2", seed=5, num_configurations=3, num_orderings=2, chain_length=3)
    write_benchmark(benchmark, folder)
    return benchmark, folder


@pytest.mark.parametrize("scene", FINGERPRINTS)
def test_the_packages_benchmark_is_frozen(scene):
    assert packaged_benchmark(scene).fingerprint == FINGERPRINTS[scene]


@pytest.mark.parametrize(("scene", "independent"), [("kitchen_2x2", 256), ("kitchen_3x3", 576)])
def test_sizes_of_the_packages_benchmark(scene, independent):
    benchmark = packaged_benchmark(scene)
    for split in ("train", "held_out"):
        assert benchmark.size("independent", split) == independent
        assert benchmark.size("sequential", split) == 640
        np.testing.assert_array_equal(benchmark.configurations[split], load_configurations(scene, split))


@pytest.mark.parametrize("scene", ["kitchen_2x2", "kitchen_3x3"])
def test_files_hold_the_benchmark_exactly(scene, tmp_path):
    benchmark = packaged_benchmark(scene)
    write_benchmark(benchmark, tmp_path)
    read = load_benchmark(str(tmp_path), scene)
    for split in ("train", "held_out"):
        np.testing.assert_array_equal(read.configurations[split], benchmark.configurations[split])
        assert read.independent[split] == benchmark.independent[split]
        assert read.sequential[split] == benchmark.sequential[split]
    assert read.fingerprint == benchmark.fingerprint
    assert read.source == str(tmp_path)


def test_the_fingerprint_is_of_poses_and_chains():
    drawn = draw_benchmark("kitchen_2x2", seed=1, num_configurations=2)
    assert drawn.fingerprint == draw_benchmark("kitchen_2x2", seed=1, num_configurations=2).fingerprint
    others = [
        draw_benchmark("kitchen_2x2", seed=2, num_configurations=2),
        draw_benchmark("kitchen_2x2", seed=1, num_configurations=2, num_orderings=9),
        draw_benchmark("kitchen_2x2", seed=1, num_configurations=3),
    ]
    assert len({drawn.fingerprint, *(other.fingerprint for other in others)}) == 4


@pytest.mark.parametrize("seed", [7, SEED])
def test_each_split_and_the_orderings_are_drawn_by_themselves(seed):
    """Whatever is asked for, a seed's first configurations and chains are the same, and nobody else's."""
    few, many = (draw_benchmark("kitchen_2x2", seed, number, num_orderings=4) for number in (4, 8))
    for split in SPLITS:
        np.testing.assert_array_equal(many.configurations[split][:4], few.configurations[split])
        chains = [[group.tasks for group in drawn.sequential[split]] for drawn in (few, many)]
        assert chains[0] == chains[1]
    known = [*many.configurations.values(), *packaged_benchmark("kitchen_2x2").configurations.values()]
    first = np.concatenate(known)[:, 0, 0]
    assert len(set(first)) == len(first) == 8 + 8 + 64 + 64


def test_what_cannot_be_drawn():
    # 4 tasks have 12 orderings of two.
    assert draw_benchmark("kitchen_2x2", 0, 1, num_orderings=12, chain_length=2).size("sequential", "train") == 12
    with pytest.raises(ValueError, match=r"num_orderings must be 1 to 12, .*got 13"):
        draw_benchmark("kitchen_2x2", 0, 1, num_orderings=13, chain_length=2)
    with pytest.raises(ValueError, match=r"chain_length must be 1 to 4, .*got 5"):
        draw_benchmark("kitchen_2x2", 0, 1, chain_length=5)


def test_drawn_chains_are_balanced_and_no_part_of_the_training_cycle():
    chains = draw_benchmark("kitchen_2x2", 3, 1, num_orderings=8, chain_length=2).sequential["train"]
    tasks = get_scene("kitchen_2x2").tasks
    for position in (0, 1):
        at = [group.tasks[position] for group in chains]
        assert [at.count(task) for task in tasks] == [2, 2, 2, 2]
    # 4 of the 12 chains of two tasks are a part of the cycle: (0, 1), (1, 2), (2, 3), (3, 0).
    for group in chains:
        assert tasks.index(group.tasks[1]) != (tasks.index(group.tasks[0]) + 1) % 4
        assert not group.is_training_cycle
    every = draw_benchmark("kitchen_2x2", 3, 1, num_orderings=12, chain_length=2).sequential["train"]
    assert [group.is_training_cycle for group in every] == [False] * 8 + [True] * 4


def test_several_files_and_further_columns(mine, tmp_path):
    benchmark, _ = mine
    write_benchmark(benchmark, tmp_path)
    whole = tmp_path / "sequential/train.parquet"
    table = pq.read_table(whole).append_column("note", pa.array(["mine"] * 6))
    pq.write_table(table.slice(0, 4), tmp_path / "sequential/train-00000-of-00002.parquet")
    pq.write_table(table.slice(4), tmp_path / "sequential/train-00001-of-00002.parquet")
    whole.unlink()
    assert read_benchmark(tmp_path, "it").fingerprint == benchmark.fingerprint


# What is wrong -------------------------------------------------------------------------------------------


def change(folder, file, row, **values):
    """Overwrite cells of a row."""
    path = folder / f"{file}.parquet"
    table = pq.read_table(path)
    rows = table.to_pylist()
    rows[row] |= values
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)


ROWS = [
    ("sequential/held_out", 4, {"instructions": ["put the spoon on the carpet"] * 3},
     r"held_out, row 4: unknown task 'put the spoon on the carpet' of playroom_2x2; valid tasks: .*bear"),
    ("independent/train", 2, {"instruction": "put the ketchup bottle on the carpet"},
     r"independent/train, row 2: unknown task 'put the ketchup bottle"),
    ("independent/train", 1, {"object": "spoon"}, r"row 1: unknown object 'spoon'; valid ones: \['toy bear', "),
    ("independent/train", 1, {"receptacle": "plate"}, r"row 1: unknown receptacle 'plate'; valid ones: \['newsp"),
    ("independent/train", 1, {"object": "plastic bottle"}, r"row 1: instruction is 'put the toy bear .*'plastic "),
    ("sequential/train", 5, {"environment": "lerobot_env_cronos/playroom_2x2-v0"},
     r"me/mine@abc, sequential/train, row 5, was made with lerobot_env_cronos/playroom_2x2-v0; this is version 1,"
     r" whose physics and success test differ: publish it anew, or use it with cronos-lerobot 0.1"),
    ("configurations/train", 1, {"environment": "lerobot_env_cronos/attic_9x9-v1"},
     r"configurations/train, row 1: unknown scene 'attic_9x9'; valid scenes: \['kitchen_2x2'"),
    ("configurations/train", 1, {"environment": "lerobot_env_cronos/kitchen_2x2-v1"},
     r"row 1: environment is lerobot_env_cronos/kitchen_2x2-v1, other rows have .*playroom_2x2-v1"),
    ("configurations/train", 0, {"environment": "playroom"}, r"row 0, does not say which version of the environ"),
    ("configurations/train", 2, {"configuration": 7}, r"row 2: configuration must be 2, .*got 7"),
    ("configurations/held_out", 2, {"toy_bear_x_m": 0.9}, r"held_out, row 2: the toy bear at \[0.9, .*out of the"),
    ("configurations/train", 2, {"carpet_z_m": -0.2}, r"row 2: the carpet must be between the table .*z = -0.2 m"),
    ("configurations/train", 2, {"carpet_qw": 3.0}, r"row 2: the carpet has a quaternion of length"),
    ("configurations/train", 2, {"carpet_y_m": float("nan")}, r"row 2: the carpet has a pose that is not finite"),
    ("configurations/train", 2, {"carpet_y_m": None}, r"row 2: carpet_y_m must be of type float, got None"),
    ("independent/held_out", 3, {"configuration": 3}, r"row 3: configuration must be 0 to 2, got 3"),
    ("independent/held_out", 3, {"window_steps": 100}, r"row 3: window_steps must be 80, got 100"),
    ("independent/held_out", 3, {"task": 0}, r"row 3: task 0 is \[.*\] here and \[.*\] in an earlier row"),
    ("independent/held_out", 2, {"configuration": 1}, r"row 2: task 0 starts from configuration 1 a second time"),
    ("sequential/held_out", 0, {"instructions": []}, r"row 0: a chain needs a task"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "row", "values", "message"), ROWS)
def test_a_bad_row_is_named(file, row, values, message, mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    change(tmp_path, file, row, **values)
    with pytest.raises(BenchmarkError, match=message):
        read_benchmark(tmp_path, "me/mine@abc")


def test_chains_of_different_lengths(mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    for row in (3, 4, 5):
        change(tmp_path, "sequential/train", row, instructions=["put the toy bear on the carpet"])
    with pytest.raises(BenchmarkError, match="row 3: a chain of 1 tasks; in earlier rows they have 3"):
        read_benchmark(tmp_path, "it")


def test_splits_of_different_tasks_or_lengths(mine, tmp_path):
    write_benchmark(mine[0], tmp_path / "tasks")
    path = tmp_path / "tasks/independent/held_out.parquet"
    table = pq.read_table(path)
    pq.write_table(table.filter(pc.field("task") != 3), path)
    with pytest.raises(BenchmarkError, match=r"independent/held_out: tasks .*; those of the training split are"):
        read_benchmark(tmp_path / "tasks", "it")
    write_benchmark(mine[0], tmp_path / "chains")
    path = tmp_path / "chains/sequential/held_out.parquet"
    rows = pq.read_table(path)
    shorter = [row | {"instructions": row["instructions"][:2]} for row in rows.to_pylist()]
    pq.write_table(pa.Table.from_pylist(shorter, schema=rows.schema), path)
    with pytest.raises(BenchmarkError, match=r"sequential/held_out: chains of \[2\] tasks; those .* have \[3\]"):
        read_benchmark(tmp_path / "chains", "it")


def test_chains_of_different_lengths_whichever_ordering_comes_first(mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    for row in (0, 1, 2):
        change(tmp_path, "sequential/train", row, ordering=1)
    for row in (3, 4, 5):
        change(tmp_path, "sequential/train", row, ordering=0, instructions=["put the toy bear on the carpet"])
    with pytest.raises(BenchmarkError, match="row 3: a chain of 1 tasks; in earlier rows they have 3"):
        read_benchmark(tmp_path, "it")


@pytest.mark.parametrize(
    ("moved_m", "turned_rad", "sign", "is_same"),
    [
        (0, 0, 1, True),
        (1e-9, 0, 1, True),
        (0, 0, -1, True),
        (0.004, 0.08, -1, True),
        (0.006, 0, 1, False),
        (0, 0.1, 1, False),
    ],
)
def test_held_out_configurations_are_held_out(moved_m, turned_rad, sign, is_same, mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    same = pq.read_table(tmp_path / "configurations/train.parquet").to_pylist()[2]
    same |= {"configuration": 1, "toy_bear_x_m": same["toy_bear_x_m"] + moved_m}
    quaternion = np.array([same[f"carpet_q{axis}"] for axis in "wxyz"])
    turned = sign * np.array([np.cos(turned_rad / 2), 0, 0, np.sin(turned_rad / 2)])
    # A turn about z after `quaternion`, which is one about z, too.
    w, z = (
        quaternion[0] * turned[0] - quaternion[3] * turned[3],
        quaternion[0] * turned[3] + quaternion[3] * turned[0],
    )
    change(tmp_path, "configurations/held_out", 1, **same | {"carpet_qw": w, "carpet_qz": z})
    if is_same:
        with pytest.raises(BenchmarkError, match="held_out, row 1: the same as training configuration 2"):
            read_benchmark(tmp_path, "it")
    else:
        read_benchmark(tmp_path, "it")


def test_bodies_that_stand_in_one_another_are_refused(mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    row = pq.read_table(tmp_path / "configurations/train.parquet").to_pylist()[2]
    bear = {f"toy_bear_{axis}_m": row[f"carpet_{axis}_m"] for axis in "xy"}
    # On the carpet, 3.7 mm thick and standing on the table, as an author may want it.
    on_top = {"toy_bear_z_m": row["toy_bear_z_m"] + 0.0037}
    change(tmp_path, "configurations/train", 2, **bear | on_top)
    read_benchmark(tmp_path, "it")
    change(tmp_path, "configurations/train", 2, **bear | {"toy_bear_z_m": row["toy_bear_z_m"]})
    message = r"configurations/train, row 2: the toy bear stands 3\.7 mm deep in the carpet"
    with pytest.raises(BenchmarkError, match=message):
        read_benchmark(tmp_path, "it")
    change(tmp_path, "configurations/train", 2, toy_bear_z_m=row["toy_bear_z_m"] + 0.0037, carpet_z_m=0.00005)
    with pytest.raises(BenchmarkError, match=r"row 2: the carpet stands 1\.8 mm deep in the table"):
        read_benchmark(tmp_path, "it")


def test_missing_and_unknown_columns_and_files(mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    path = tmp_path / "configurations/train.parquet"
    table = pq.read_table(path)
    pq.write_table(table.rename_columns([name.replace("toy_bear", "robot") for name in table.column_names]), path)
    with pytest.raises(BenchmarkError, match=r"columns \['toy_bear_x_m', .* are missing"):
        read_benchmark(tmp_path, "it")
    pq.write_table(table.append_column("spoon_x_m", pa.array([0.1] * 3)), path)
    with pytest.raises(
        BenchmarkError, match=r"column 'spoon_x_m' is of no body of playroom_2x2; its bodies: \['toy"
    ):
        read_benchmark(tmp_path, "it")
    path.write_text(json.dumps({"not": "parquet"}))
    with pytest.raises(BenchmarkError, match="configurations/train: not a parquet file"):
        read_benchmark(tmp_path, "it")
    path.unlink()
    with pytest.raises(
        BenchmarkError, match=r"it, configurations/train: there is no configurations/train.parquet"
    ):
        read_benchmark(tmp_path, "it")


# Environments --------------------------------------------------------------------------------------------


def test_the_scene_follows_from_the_benchmark(mine):
    _, folder = mine
    assert CronosEnvConfig(benchmark=str(folder), obs_type=STATE).scene == "playroom_2x2"
    with pytest.raises(ValueError, match="is of playroom_2x2, not of kitchen_3x3"):
        CronosEnvConfig(benchmark=str(folder), scene="kitchen_3x3", obs_type=STATE)
    with pytest.raises(ValueError, match="no benchmark 'no folder': expected <owner>"):
        CronosEnvConfig(benchmark="no folder")


@pytest.mark.parametrize("suite", ["independent", "sequential"])
def test_episodes_start_where_the_benchmark_says(suite, mine, tmp_path):
    benchmark, _ = mine
    write_benchmark(benchmark, tmp_path)
    # The second task or chain starts from the configurations 2 and 0 only, in this order.
    path = tmp_path / suite / "held_out.parquet"
    rows = pq.read_table(path)
    pq.write_table(pa.concat_tables([rows.slice(0, 3), rows.slice(5, 1), rows.slice(3, 1), rows.slice(6)]), path)
    config = CronosEnvConfig(benchmark=str(tmp_path), suite=suite, split="held_out", obs_type=STATE)
    envs = config.create_envs(3)[f"{suite}_held_out"]
    assert list(envs) == list(range(4 if suite == "independent" else 2))
    env = envs[1]
    env.reset(seed=1000)
    # 1000 is even, so the first of three episodes starts from the first of the two configurations.
    expected = benchmark.configurations["held_out"][[2, 0, 2]]
    for i, body in enumerate(benchmark.scene.bodies):
        np.testing.assert_allclose(env.simulation.body_pose(body)[:, :2], expected[:, i, :2], atol=2e-3)
    assert env.call("task_description")[0] == benchmark.groups(suite, "held_out")[1].instructions[0]


def test_one_task_or_ordering_by_name(mine):
    _, folder = mine
    options = {"benchmark": str(folder), "obs_type": STATE}
    config = CronosEnvConfig(**options, task="put the toy bear on the carpet")
    assert len(config.create_envs(1)["independent_train"]) == 1
    assert list(CronosEnvConfig(**options, suite="sequential", task="1").create_envs(1)["sequential_train"]) == [1]
    with pytest.raises(ValueError, match=r"unknown ordering '2' of .*; valid orderings: \['0', '1'\]"):
        CronosEnvConfig(**options, suite="sequential", task="2")


def test_streams_are_reset_to_its_configurations(mine):
    benchmark, folder = mine
    env = CronosVectorEnv(5, "playroom_2x2", obs_type=STATE, benchmark=str(folder))
    env.reset(seed=1)
    expected = benchmark.configurations["train"][[1, 2, 0, 1, 2], 0, :2]
    np.testing.assert_allclose(env.simulation.body_pose("toy bear")[:, :2], expected, atol=2e-3)
    with pytest.raises(ValueError, match=r"configurations must be 0 to 2 of train, benchmark .*got \[3\]"):
        env.scene_reset(np.array([0]), np.array([3]))
