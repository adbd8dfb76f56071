"""Only known files are pushed, no link leads out of their folder, and text has nothing private."""

import json

import pytest

from cronos_lerobot.hub.cards import cell, command, render_card
from cronos_lerobot.hub.stage import clean, stage, write_text

TOKEN = "hf_" + "aB3" * 11


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("--output_dir=/scratch/me/runs/eer", "--output_dir=.../eer"),
        ("/mnt/my data/demos/", ".../demos"),
        ("--env.benchmark=/data/bench@v1", "--env.benchmark=.../bench@v1"),
        ("--x=['/a/b c/d', \"/e/f\"]", "--x=['.../d', \".../f\"]"),
        ("--x={a: /secret/b, c: [/d/e,/f/g]}", "--x={a: .../b, c: [.../e,.../g]}"),
        ("--output_dir=/home/me/eer", "--output_dir=~/eer"),
        ("--x=['/home/me', '/home/me/a']", "--x=['~', '~/a']"),
        ("/home/melanie/eer", "~/eer"),
        ("/Users/melanie/eer and /root/x", "~/eer and ~/x"),
        ("--output_dir=/mnt/home/me/eer", "--output_dir=.../eer"),
        (f"--hub.token={TOKEN} https://me:{TOKEN}@x.org/a", "--hub.token=<token> https://me:<token>@x.org/a"),
        ("ghp_0123456789abcdefABCD, sk-proj-0123456789abcdef", "<token>, <token>"),
    ],
)
def test_folders_and_tokens_are_not_told(monkeypatch, text, shown):
    monkeypatch.setenv("HOME", "/home/me")
    assert clean(text) == shown


@pytest.mark.parametrize(
    "text",
    ["--output_dir=outputs/train/eer", "--x=./a/b", "--x=~/a", "--policy.path=me/clone", "--x=https://a.org/b/c",
     "--ratio=1/2", "--x=[a/b, c/d]", "'put the spoon / knife away'", "hf_hub_download_timeout",
     "task-switch-interval",
     "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"],
)  # fmt: skip
def test_everything_else_stays(text):
    assert clean(text) == text


@pytest.fixture
def folder(tmp_path):
    """Somebody's folder, with more in it than a policy."""
    root = tmp_path / "model"
    (root / "keys").mkdir(parents=True)
    for name in (".env", "id_rsa", "keys/token", "model.safetensors"):
        (root / name).write_text(TOKEN)
    (root / "config.json").write_text('{"type":  "act"}')
    settings = {"wandb": {"notes": "dear diary", "entity": "lab"}, "output_dir": "/scratch/me/eer", "hub": [TOKEN]}
    (root / "train_config.json").write_text(json.dumps(settings))
    return root


def test_a_link_may_lead_within_the_folder_and_not_out_of_it(folder, tmp_path):
    (tmp_path / "secret.json").write_text("{}")
    (folder / "inside.json").symlink_to("config.json")
    (folder / "outside.json").symlink_to("../secret.json")
    (folder / "others").symlink_to(tmp_path)
    stage(folder, ["inside.json"], tmp_path / "out")
    assert (tmp_path / "out/inside.json").read_text() == '{"type":  "act"}'
    for name in ("outside.json", "others/secret.json", "../secret.json"):
        with pytest.raises(ValueError, match="leads out of"):
            stage(folder, [name], tmp_path / "other")


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "\ud800".encode("utf-8", "surrogatepass").decode("latin1")])
def test_damaged_json_is_named(folder, tmp_path, text):
    (folder / "config.json").write_text(text)
    with pytest.raises(ValueError, match=r"config\.json is damaged"):
        stage(folder, ["config.json"], tmp_path / "out")


def test_a_value_on_a_card_stays_in_its_line_and_its_code(tmp_path):
    evil = "x`\n```\n# Injected\n<img src=x>|y"
    assert command(["cronos-eval", f"--a={evil}"]) == "cronos-eval \\\n    '--a=x # Injected <img src=x>|y'"
    assert cell(evil) == "`x # Injected <img src=x>\\|y`"
    values = dict.fromkeys(("license", "base_model", "dataset", "scene", "repo_id"), evil)
    values |= dict.fromkeys(("is_adapter", "is_steered", "is_reset_free", "run")) | {"plays_in_lerobot": True}
    results = [{"suite": evil, "split": evil, "success": 0.5, "ci95": [0, 1], "n": 2}]
    evaluate = {name: [name, f"--policy.path={evil}"] for name in ("cronos-eval", "lerobot-eval")}
    lists = {name: [evil] for name in ("tags", "settings", "differences")}
    card = render_card(
        "policy", policy={"type": evil}, results=results, flags={evil: evil}, evaluate=evaluate, **values, **lists
    )
    assert not [line for line in card.splitlines() if line.startswith(("# Injected", "<img"))]
    assert card.count("\n```") == 6
    write_text(tmp_path / "README.md", card + f"\n{TOKEN}")
    assert TOKEN not in (tmp_path / "README.md").read_text()
