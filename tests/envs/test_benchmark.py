"""Your own benchmarks: files, their checks, and the environments that run them."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from env_rollouts import STATE
from lerobot_env_cronos import CronosEnvConfig, get_scene, load_benchmark
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark, packaged_benchmark
from lerobot_env_cronos.benchmark.files import BenchmarkError, read_benchmark, write_benchmark

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


@pytest.mark.parametrize("wrong", [{"num_orderings": 13, "chain_length": 2}, {"chain_length": 5}])
def test_what_cannot_be_drawn(wrong):
    """4 tasks have 12 orderings of two."""
    assert draw_benchmark("kitchen_2x2", 0, 1, num_orderings=12, chain_length=2).size("sequential", "train") == 12
    with pytest.raises(ValueError, match=next(iter(wrong))):
        draw_benchmark("kitchen_2x2", 0, 1, **wrong)


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
    ("sequential/held_out", 4, {"instructions": ["put the spoon on the carpet"] * 3}, "held_out, row 4.*spoon"),
    ("independent/train", 2, {"instruction": "put the ketchup bottle on the carpet"}, "train, row 2.*ketchup"),
    ("sequential/train", 5, {"environment": "lerobot_env_cronos/playroom_2x2-v0"}, "environment.*v0"),
    ("configurations/train", 1, {"environment": "lerobot_env_cronos/kitchen_2x2-v1"}, "environment"),
    ("configurations/train", 2, {"configuration": 7}, "row 2: configuration"),
    ("configurations/held_out", 2, {"toy_bear_x_m": 0.9}, "held_out, row 2: the toy bear"),
    ("configurations/train", 2, {"carpet_qw": 3.0}, "row 2: the carpet"),
    ("configurations/train", 2, {"carpet_y_m": float("nan")}, "row 2: the carpet"),
    ("configurations/train", 2, {"carpet_y_m": None}, "carpet_y_m"),
    ("independent/held_out", 3, {"configuration": 3}, "row 3: configuration"),
    ("independent/held_out", 3, {"window_steps": 100}, "row 3: window_steps"),
    ("independent/held_out", 3, {"task": 0}, "row 3: task 0"),
    ("independent/held_out", 2, {"configuration": 1}, "row 2: task 0 starts from configuration 1"),
    ("sequential/held_out", 0, {"instructions": []}, "other tasks"),
]


@pytest.mark.parametrize(("file", "row", "values", "message"), ROWS)
def test_a_bad_row_is_named(file, row, values, message, mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    change(tmp_path, file, row, **values)
    with pytest.raises(BenchmarkError, match=f"me/mine@abc, .*{message}"):
        read_benchmark(tmp_path, "me/mine@abc")


@pytest.mark.parametrize(("file", "key"), [("independent/train", "task"), ("sequential/held_out", "ordering")])
def test_numbers_that_do_not_begin_with_0_are_refused(file, key, mine, tmp_path):
    """They would be taken for places in a list, and each task would get another's results."""
    write_benchmark(mine[0], tmp_path)
    for row, values in enumerate(pq.read_table(tmp_path / f"{file}.parquet").to_pylist()):
        change(tmp_path, file, row, **{key: values[key] + 1})
    with pytest.raises(BenchmarkError, match=file):
        read_benchmark(tmp_path, "it")


HOSTILE = {
    # Files of kilobytes that hold gigabytes.
    "rows": lambda table: repeat_row(table, 1_000_000),
    "list": lambda table: repeat_in_list(table, 5_000_000),
    "a text": lambda table: repeat_row(table, 50_000, "x" * 1_000_000),
    "metadata": lambda table: table.replace_schema_metadata({"lerobot_env_cronos.bodies": "[" * 900_000}),
    "nested metadata": lambda table: table.replace_schema_metadata({"lerobot_env_cronos.bodies": "[" * 100_000}),
    "columns": lambda table: pa.table(
        {name: table.column(name) for name in table.column_names}
        | {f"nobody_{i}_x_m": pa.array([0.0] * len(table)) for i in range(11_000)}
    ),
}


def repeat_row(table, number, text=None):
    """A table of one row, many times, stored as a dictionary."""
    first = {name: table.column(name).slice(0, 1).combine_chunks() for name in table.column_names}
    if text is not None:
        first["environment"] = pa.array([text])
    indices = pa.array(np.zeros(number, dtype=np.int32))
    return pa.table({name: pa.DictionaryArray.from_arrays(indices, value) for name, value in first.items()})


def repeat_in_list(table, number):
    """A table of one row, whose chain is very long."""
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(number, np.int8)), pa.array(["put the toy bear"]))
    chain = pa.ListArray.from_arrays(pa.array([0, number], pa.int32()), texts)
    return table.slice(0, 1).set_column(table.column_names.index("instructions"), "instructions", chain)


@pytest.mark.parametrize("what", HOSTILE)
def test_a_small_file_that_holds_gigabytes_is_refused_in_a_short_message(what, mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    path = tmp_path / ("sequential" if what == "list" else "configurations") / "train.parquet"
    pq.write_table(HOSTILE[what](pq.read_table(path)), path, compression="zstd")
    assert path.stat().st_size < 4e6
    before = pa.default_memory_pool().max_memory()
    with pytest.raises(BenchmarkError) as raised:
        read_benchmark(tmp_path, "it")
    assert len(str(raised.value)) < 1000
    assert pa.default_memory_pool().max_memory() < before + 1e8


def test_columns_that_are_not_needed_are_not_read(mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    path = tmp_path / "independent/train.parquet"
    table = pq.read_table(path)
    large = pa.DictionaryArray.from_arrays(pa.array([0] * len(table)), pa.array(["x" * 10_000_000]))
    pq.write_table(table.append_column("note", large), path, compression="zstd")
    assert read_benchmark(tmp_path, "it").fingerprint == mine[0].fingerprint


def test_held_out_configurations_are_held_out(mine, tmp_path):
    write_benchmark(mine[0], tmp_path)
    same = pq.read_table(tmp_path / "configurations/train.parquet").to_pylist()[2] | {"configuration": 1}
    change(tmp_path, "configurations/held_out", 1, **same)
    with pytest.raises(BenchmarkError, match=r"held_out, row 1.*training configuration 2"):
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
    wrong = {
        "toy_bear_x_m": table.drop_columns("toy_bear_x_m"),
        "spoon_x_m": table.append_column("spoon_x_m", pa.array([0.1] * 3)),
        "configuration": table.drop_columns("configuration"),
        "1 to": table.slice(0, 0),
    }
    for named, changed in wrong.items():
        pq.write_table(changed, path)
        with pytest.raises(BenchmarkError, match=f"configurations/train.*{named}"):
            read_benchmark(tmp_path, "it")
    path.write_text("not parquet")
    with pytest.raises(BenchmarkError, match="configurations/train"):
        read_benchmark(tmp_path, "it")
    path.unlink()
    with pytest.raises(BenchmarkError, match=r"configurations/train\.parquet"):
        read_benchmark(tmp_path, "it")


# Environments --------------------------------------------------------------------------------------------


def test_the_scene_follows_from_the_benchmark(mine):
    _, folder = mine
    assert CronosEnvConfig(benchmark=str(folder), obs_type=STATE).scene == "playroom_2x2"
    for wrong in ({"benchmark": str(folder), "scene": "kitchen_3x3"}, {"benchmark": "no folder"}):
        with pytest.raises(ValueError, match="benchmark"):
            CronosEnvConfig(**wrong)


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
