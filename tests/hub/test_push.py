"""What a Hub does wrong ends a push with one line that says it."""

import pytest
from hub_repositories import Repository
from lerobot_env_cronos import load_benchmark

from cronos_lerobot.hub import push
from cronos_lerobot.hub.config import PublishConfig
from cronos_lerobot.hub.policy import FILES
from cronos_lerobot.hub.push import PublishError, check_holds, limit_waiting, matching, push_folder


@pytest.fixture
def tree(tmp_path):
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree/config.json").write_text("{}")
    return tmp_path / "tree"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ((429, b"slow down"), "429"),
        ((500, b"<html>\n\n<body>Oops</body>"), "500"),
        ((503, b""), "503"),
        ((200, b"<html>Log in to the hotel's network</html>"), "HF_ENDPOINT"),
        ((200, b"[]"), "HF_ENDPOINT"),
        ((418, b"I am\na teapot"), "418"),
    ],
)
def test_an_answer_of_another_kind(here, tree, answer, said):
    here.faults.answer = answer
    for use in (
        lambda: push_folder(tree, PublishConfig("me/wrong"), "model", "Publish"),
        lambda: check_holds("me/wrong", "model", ["env.py"], "choose another"),
    ):
        with pytest.raises(PublishError, match=said) as error:
            use()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("fault", "said"), [("refuse_tokens", "401.*HF_TOKEN"), ("read_only_tokens", "403")])
def test_a_token_that_may_not_write(here, tree, fault, said):
    setattr(here.faults, fault, True)
    with pytest.raises(PublishError, match=said):
        push_folder(tree, PublishConfig("me/forbidden"), "model", "Publish")


def test_a_server_that_never_answers(here, tree, monkeypatch):
    monkeypatch.setattr(push, "TIMEOUT_S", 0.2)
    limit_waiting()
    here.repositories["models", "me/silent"] = Repository("models", "me/silent")
    here.faults.is_silent = True
    with pytest.raises(PublishError, match="did not answer in time"):
        push_folder(tree, PublishConfig("me/silent"), "model", "Publish", replaces=["*"])
    with pytest.raises(ValueError, match="me/silent"):
        load_benchmark("me/silent", "kitchen_2x2")


@pytest.mark.parametrize("name", ["justname", "me/a/b", "me/with space"])
def test_a_repository_has_an_owner_and_a_name(name):
    with pytest.raises(ValueError, match=f"--repo_id={name}"):
        PublishConfig(repo_id=name).validate()


def test_a_dry_run_overwrites_nothing(tmp_path):
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(FileExistsError, match="--output_dir"):
        PublishConfig(repo_id="me/x", dry_run=True, output_dir=tmp_path).validate()


def test_a_policy_that_is_pushed_again_leaves_nothing_that_would_be_loaded_with_it():
    there = ["steering.safetensors", "adapter_model.safetensors", "adapter_config.json", "tokenizer.model",
             "config.json", "model-00001-of-00002.safetensors", "model.safetensors.index.json",
             "policy_preprocessor_step_5_normalizer_processor.safetensors",
             "policy_postprocessor.json"]  # fmt: skip
    kept = [".eval_results/me_bench.yaml", "README.md", ".gitattributes", "requirements.txt", "LICENSE.txt",
            "checkpoints/5000/model.safetensors", "onnx/config.json", "notes.json", "demo_actions.safetensors",
            "model_of_mine.safetensors", "policy_notes.json", "policy_preprocessor_key"]  # fmt: skip
    assert matching([*there, *kept], FILES) == there
