"""LeRobot's reward classifiers judge a simulated robot by its pictures, and run nothing of a stranger's."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.rewards import make_reward_model, make_reward_pre_post_processors
from lerobot.rewards.classifier.configuration_classifier import RewardClassifierConfig
from lerobot_robot_cronos import CronosPersonConfig, CronosSO101Config
from transformers import ResNetConfig, ResNetModel

from cronos_lerobot.robot.config import CronosRobotConfig
from cronos_lerobot.robot.person import Events
from cronos_lerobot.robot.reward_models import RewardModel, RewardModelJudge

FRONT = "observation.images.front"
CUBE_ON_PLATE, MARKER_ON_PLATE = "put_the_cube_on_the_plate", "put_the_marker_on_the_plate"
TASKS = ("put_the_cube_on_the_box_lid", CUBE_ON_PLATE, "put_the_marker_on_the_box_lid", MARKER_ON_PLATE)


def save(folder: Path, encoder: Path, bias: float | None) -> None:
    """A classifier that always says the same, or that calls bright pictures a success."""
    feature = PolicyFeature(FeatureType.VISUAL, (3, 128, 128))
    config = RewardClassifierConfig(
        input_features={FRONT: feature}, num_cameras=1, model_name=str(encoder), device="cpu"
    )
    model = make_reward_model(config)
    last = model.classifier_head[-1]
    if bias is None:
        pictures = torch.cat([torch.full((4, 3, 128, 128), -2.0), torch.full((4, 3, 128, 128), 2.0)])
        batch = {FRONT: pictures, "next.reward": torch.arange(8) // 4 * 1.0}
        model.eval()
        optimizer = torch.optim.Adam(model.classifier_head.parameters(), lr=0.01)
        for _ in range(30):
            loss = model(batch)[0]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    else:
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.constant_(last.bias, bias)
    stats = {FRONT: {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)}}
    model.save_pretrained(folder)
    make_reward_pre_post_processors(config, dataset_stats=stats)[0].save_pretrained(folder)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """Cubes are always on what they belong on, markers never; the markers' are as `lerobot-train` leaves them."""
    torch.manual_seed(0)
    root = tmp_path_factory.mktemp("trained")
    ResNetModel(
        ResNetConfig(embedding_size=4, hidden_sizes=[4] * 4, depths=[1] * 4, layer_type="basic")
    ).save_pretrained(root / "encoder")
    for name in TASKS:
        inside = "" if "cube" in name else "checkpoints/last/pretrained_model"
        save(root / "judges" / name / inside, root / "encoder", 9.0 if "cube" in name else -9.0)
    save(root / "bright", root / "encoder", None)
    return root


@pytest.fixture
def judges(trained, tmp_path) -> Path:
    return shutil.copytree(trained / "judges", tmp_path / "judges")


def robot_streams(judge, cameras=("front",), **flags):
    robot = CronosSO101Config(id="desk", real_time=False, camera_names=list(cameras), camera_height=96)
    teleop = CronosPersonConfig(robot_id="desk", judges=False)
    return CronosRobotConfig(robot=robot, teleop=teleop, judge=str(judge), **flags).create_streams(1)


def edit(file: Path, **changes) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_recordings_say_who_judges_and_how_often_it_is_wrong(judges):
    env = robot_streams(judges, judge_error=0.04)
    env.set_task(np.array([0]), env.tasks[:1])
    # Of its own camera's picture.
    assert not env.step(env.station.target[None])[4]["is_success"][0]
    env.close()
    name, _, error = env.identity.source.partition(", wrong in ")
    assert name.startswith("so101_desk_2x2, judge reward_classifier ")
    assert error == "4.0% of the segments"


def test_a_success_is_ten_verdicts_in_a_row_after_a_failure(judges, trained):
    shutil.rmtree(judges / CUBE_ON_PLATE)
    shutil.copytree(trained / "bright", judges / CUBE_ON_PLATE)
    cube, marker = (
        SimpleNamespace(instruction=name.replace("_", " ")) for name in (CUBE_ON_PLATE, MARKER_ON_PLATE)
    )
    judge = RewardModelJudge(judges, (cube, marker), (), {"front": None})

    def judged(task, levels):
        judge.begin(task)
        pictures = [np.full((128, 128, 3), level, np.uint8) for level in levels]
        return [judge.judge({"front": picture}, Events()) for picture in pictures]

    dark, bright = [0] * 3, [255] * 3
    # One verdict in every third step.
    assert judged(cube, dark + 10 * bright) == [False] * 30 + [True] * 3
    assert not any(judged(cube, dark + 9 * bright + dark + 9 * bright))
    # It began complete.
    assert not any(judged(cube, 20 * bright))
    # Each task has its own.
    assert not any(judged(marker, dark + 20 * bright))


def test_pictures_of_any_size_reach_the_model_as_in_training(trained):
    model = RewardModel(trained / "bright")
    pictures = np.concatenate([np.full((1, 240, 320, 3), level, np.uint8) for level in (0, 255, 10)])
    assert model.successes({"front": pictures}).tolist() == [False, True, False]


def test_a_folder_that_does_not_fit(judges):
    with pytest.raises(ValueError, match=r"must be one of \('person', 'sim'\) or a folder, got 'nobody'"):
        robot_streams("nobody")
    with pytest.raises(ValueError, match=r"looks at \['front'\]; the robot has \['wrist'\]"):
        robot_streams(judges, cameras=["wrist"])
    (judges / TASKS[0] / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=rf"{TASKS[0]} cannot judge"):
        robot_streams(judges)
    shutil.rmtree(judges / CUBE_ON_PLATE)
    with pytest.raises(ValueError, match=rf"needs the folders \['{CUBE_ON_PLATE}'\].* it has .*'{TASKS[0]}'"):
        robot_streams(judges)


@pytest.mark.parametrize("model_type", ["theirs", "resnet"])
def test_the_code_of_an_encoder_is_not_run(judges, trained, tmp_path, model_type):
    encoder, trace = shutil.copytree(trained / "encoder", tmp_path / "encoder"), tmp_path / "trace"
    (encoder / "theirs.py").write_text(
        f"open({str(trace)!r}, 'w').close()\n"
        "from transformers import ResNetConfig, ResNetModel\n"
        "class C(ResNetConfig):\n    model_type = 'theirs'\n"
        "class M(ResNetModel):\n    config_class = C\n"
    )
    edit(
        encoder / "config.json",
        model_type=model_type,
        auto_map={"AutoConfig": "theirs.C", "AutoModel": "theirs.M"},
    )
    edit(judges / CUBE_ON_PLATE / "config.json", model_name=str(encoder))
    if model_type == "resnet":
        # transformers has it, and takes its own.
        RewardModel(judges / CUBE_ON_PLATE)
    else:
        with pytest.raises(ValueError, match=f"{CUBE_ON_PLATE} cannot judge: .*custom code"):
            RewardModel(judges / CUBE_ON_PLATE)
    assert not trace.exists()


@pytest.mark.parametrize(
    "step",
    [
        {"class": "subprocess.Popen", "config": {"args": ["touch", "trace"]}},
        {"registry_name": "reward_classifier", "config": {"pretrained_path": "their/model"}},
    ],
)
def test_processors_of_others_are_not_made(judges, step):
    edit(judges / CUBE_ON_PLATE / "classifier_preprocessor.json", steps=[step])
    with pytest.raises(ValueError, match=r"are not run; valid: \('normalizer_processor', 'device_processor'\)"):
        RewardModel(judges / CUBE_ON_PLATE)


def test_other_reward_models_are_refused(judges):
    edit(judges / CUBE_ON_PLATE / "config.json", type="robometer")
    with pytest.raises(ValueError, match="of the type 'robometer'; valid: 'reward_classifier'"):
        RewardModel(judges / CUBE_ON_PLATE)
