"""What tells one policy from another, and which checkpoint the last one is."""

import json
import shutil
from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.evaluation.policy_source import files_fingerprint, find_policy, fingerprint, pin_policy


@pytest.fixture
def pocketvla(tmp_path):
    return save_policy(tmp_path / "pocketvla", "pocketvla", STATE, hidden_width=16, hidden_depth=1)


def test_a_policy_is_known_by_its_files_and_not_by_its_folder(pocketvla, tmp_path):
    def fingerprint_of(folder):
        config = PreTrainedConfig.from_pretrained(folder)
        config.pretrained_path = folder
        return fingerprint(config)

    copy = shutil.copytree(pocketvla, tmp_path / "copy")
    assert fingerprint_of(copy) == fingerprint_of(pocketvla)
    (copy / "train_config.json").write_text("{}")
    assert fingerprint_of(copy) == fingerprint_of(pocketvla)
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(config | {"device": "cuda"}))
    assert fingerprint_of(copy) == fingerprint_of(pocketvla), "a GPU loads the same policy"
    seen = {fingerprint_of(pocketvla)}
    for name in ("model.safetensors", "policy_preprocessor.json"):
        file = copy / name
        changed = file.read_bytes()
        file.write_bytes(changed[:-1] + bytes([changed[-1] ^ 1]))
        seen.add(fingerprint_of(copy))
    assert len(seen) == 3
    # Adapters are loaded onto what lies in their base's folder then, wherever that is called so from.
    base = tmp_path / "base"
    base.mkdir()
    both = []
    for weights, name in ((b"first", str(base)), (b"second", str(base)), (b"second", "base"), (b"", "me/base")):
        (base / "model.safetensors").write_bytes(weights)
        (copy / "adapter_config.json").write_text(json.dumps({"r": 4, "base_model_name_or_path": name}))
        alone = files_fingerprint(copy, with_base=False)
        both.append((fingerprint_of(copy), files_fingerprint(copy), alone))
    for first, second, relative, of_the_hub in list(zip(*both, strict=True))[:2]:
        assert len({first, second, of_the_hub}) == 3
        assert relative == second
    # Published, they name a repository as their base; they are the same adapters.
    assert len({alone for *_, alone in both}) == 1
    (copy / "adapter_config.json").write_text(json.dumps({"r": 8, "base_model_name_or_path": "me/base"}))
    assert files_fingerprint(copy, with_base=False) != both[-1][2]


def test_the_last_checkpoint_is_the_one_that_was_last_when_it_was_looked_up(pocketvla, tmp_path):
    checkpoints = tmp_path / "run/checkpoints"
    for step in ("000100", "000200"):
        shutil.copytree(pocketvla, checkpoints / step / "pretrained_model")
    (checkpoints / "last").symlink_to("000100")
    source = find_policy(str(checkpoints / "last/pretrained_model"))
    (checkpoints / "last").unlink()
    (checkpoints / "last").symlink_to("000200")
    assert source.folder == checkpoints / "000100/pretrained_model"
    assert source.name == str(source.folder)
    # Other links are the user's own names.
    (tmp_path / "mine").symlink_to(checkpoints / "000100/pretrained_model")
    assert find_policy(str(tmp_path / "mine")).name == str(tmp_path / "mine")


@pytest.mark.parametrize("name", ["kitchen_2x2_state", "kitchen_2x2_pixels"])
def test_an_official_base_is_found_by_its_name_and_is_what_its_card_says(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = find_policy(name)
    assert (source.name, pin_policy(name, None)) == (name, (str(source.folder), None))
    weights = files_fingerprint(source.folder)
    assert f"Fingerprint: `{weights}`" in (source.folder / "README.md").read_text()
    benchmark = Path(__file__).parents[2] / "docs/benchmark.md"
    assert f"| `{name}` | `{weights}` |" in benchmark.read_text()
    # A folder of that name is what it is everywhere else: a folder.
    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match="no checkpoint"):
        find_policy(name)


def test_a_name_that_is_nowhere_is_an_error_that_names_the_official_bases():
    with pytest.raises(ValueError, match="kitchen_2x2_state"):
        find_policy("kitchen_5x5_state")
