"""The ways of cloning a recorded stream differ in what they say they differ in, and in nothing else."""

import pytest

from cronos_lerobot.scripts.demo import SCALES
from cronos_lerobot.studies import learn_from_streams
from cronos_lerobot.studies.learn_from_streams import WAYS, make_steps


def flags_of(step):
    return dict(flag.split("=", 1) for flag in step.command[1:] if "=" in flag)


def test_each_way_has_its_own_data_and_the_base_s_recipe(tmp_path):
    steps = {step.name: step for step in make_steps(SCALES["smoke"], [7], tmp_path, tuple(WAYS), "flow")}
    base = flags_of(steps["clone"])
    assert base["--policy.head"] == "flow"
    streams, progress = str(tmp_path / "run/streams"), str(tmp_path / "progress.parquet")
    expected = {
        "plain": {"--dataset.root": streams},
        "filtered": {"--dataset.root": str(tmp_path / "successes")},
        "weighted": {
            "--dataset.root": streams,
            "--sample_weighting.type": "rabc",
            "--sample_weighting.progress_path": progress,
        },
    }
    for way, own in expected.items():
        flags = flags_of(steps[f"{way}_7"])
        changed = {name: value for name, value in flags.items() if base.get(name) != value}
        assert changed.pop("--output_dir") == str(tmp_path / f"{way}_7")
        assert changed.pop("--seed") == "7"
        assert changed.pop("--dataset.repo_id") != base["--dataset.repo_id"]
        assert changed == own
        assert base.keys() <= flags.keys()
    # The weights are of the frames that are cloned by them.
    assert flags_of(steps["weigh"])["--dataset.root"] == streams
    assert flags_of(steps["weigh"])["--output"] == progress
    assert flags_of(steps["filter"])["--dataset.root"] == streams
    assert flags_of(steps["train"])["--record.streams"] == "all"


def test_only_what_is_asked_for_is_made(tmp_path):
    names = [step.name for step in make_steps(SCALES["smoke"], [1, 2], tmp_path)]
    assert [name for name in names if not name.endswith(("train", "held_out"))] == [
        "record", "clone", "filter", "filtered_1", "filtered_2"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "steps"),
    [((), 153_600), (("--steps=10240",), 10_240), (("--scale=smoke",), SCALES["smoke"].train_steps),
     (("--scale=smoke", "--steps=10240"), 10_240)],
)  # fmt: skip
def test_scale_and_steps_are_followed(flags, steps, tmp_path, monkeypatch):
    asked = []

    def stop(made, folder):
        asked.extend(made)
        raise FileExistsError("no further")

    monkeypatch.setattr(learn_from_streams, "run_steps", stop)
    monkeypatch.setattr("sys.argv", ["learn_from_streams", f"--output_dir={tmp_path}", *flags])
    with pytest.raises(SystemExit, match="no further"):
        learn_from_streams.main()
    (train,) = (step for step in asked if step.name == "train")
    assert flags_of(train)["--steps"] == str(steps)
