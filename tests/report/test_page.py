"""The page shows the inputs' numbers, is self-contained, and embeds nothing but videos of its folders."""

import base64
import csv
import json
import re
import sys

import pytest
from synthetic_evaluations import AFTER, BEFORE, write_evaluation
from synthetic_runs import INSTRUCTIONS, edit_lines, write_training_run

from cronos_lerobot.report.page import write_report
from cronos_lerobot.scripts.report import main, make_report

FIGURES = ("evaluation", "training", "segments")


def page_of(tmp_path, *folders, **options):
    return write_report(make_report(list(folders), **options), tmp_path / "report").read_text()


def read_csv(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The folder of a report of a training run and evaluations before and after, and its page."""
    folder = tmp_path_factory.mktemp("inputs")
    write_training_run(folder / "run", successes=(2, 3, 5))
    write_evaluation(folder / "before", "me/a", tasks=BEFORE, video=b"old video")
    write_evaluation(folder / "after", "me/b", tasks=AFTER, video=b"new video")
    sides = {"before": [folder / "before"], "after": [folder / "after"]}
    return folder / "report", page_of(folder, folder / "run", **sides)


def test_page_shows_the_inputs_numbers(report):
    _, page = report
    # 10/32 -> 26/32.
    assert "31.2 &rarr; 81.2 %" in page
    assert "n = 32, 1 seed" in page
    cells = re.findall(r"<td>(.*?)</td>", page)
    row = cells[cells.index(INSTRUCTIONS[0]) :][:6]
    assert row[1:3] == ["8", "1"]
    assert row[3].startswith("0.125 [")
    assert row[5].startswith("0.875 [")
    assert "&#34;mujoco&#34;: &#34;4.0.0&#34;" in page


def test_page_is_self_contained(report):
    folder, page = report
    sources = re.findall(r'(?:src|href)="(.*?)"', page)
    assert len(sources) == len(FIGURES) + 2
    assert all(source.startswith("data:") for source in sources)
    videos = [base64.b64decode(s.split(",")[1]) for s in sources if s.startswith("data:video")]
    assert videos == [b"old video", b"new video"]
    for name in FIGURES:
        content = base64.b64encode((folder / f"{name}.png").read_bytes()).decode()
        assert f"data:image/png;base64,{content}" in page


def test_csv_files_hold_every_number(report):
    folder, _ = report
    gains = {(row["suite"], row["task"]): row for row in read_csv(folder / "gains.csv")}
    overall = gains["independent_held_out", "all tasks"]
    assert (overall["before"], overall["after"], overall["gain"]) == ("0.3125", "0.8125", "0.5")
    assert len(read_csv(folder / "evaluations.csv")) == 3 * 5
    assert {row["seed"] for row in read_csv(folder / "evaluations.csv")} == {"0"}
    updates = read_csv(folder / "updates.csv")
    assert [float(row["agent/approx_kl"]) for row in updates] == [0.01 * i for i in range(1, 9)]
    assert updates[0]["agent/explained_variance"] == ""
    assert sum(int(row["n"]) for row in read_csv(folder / "segments.csv") if row["kind"] == "segment") == 8 * 16
    (interventions,) = read_csv(folder / "interventions.csv")
    assert (interventions["scene_reset"], interventions["initial"]) == ("32", "8")


def test_suites_of_cronos_eval_have_tables_and_figures(tmp_path):
    write_evaluation(tmp_path / "eval", "me/a", tasks=["1100"] * 4)
    write_evaluation(tmp_path / "eval", "me/a", chains=[[0, 4], [1, 2]], split="train")
    write_evaluation(tmp_path / "eval", "me/a", stream=["1101", "0001"])
    page = page_of(tmp_path, tmp_path / "eval")
    assert all(
        f"<h2>{title}" in page for title in ("Sequential suite", "Stream suite", "cronos-eval: single tasks")
    )
    assert {path.stem for path in (tmp_path / "report").glob("*.png")} == {"sequential", "stream"}
    assert [row["success"] for row in read_csv(tmp_path / "report/stream.csv")][1:] == ["0.5", "0.5", "0.0", "1.0"]


def test_what_another_report_left_is_removed(tmp_path):
    write_evaluation(tmp_path / "eval", "me/a", tasks=BEFORE)
    (tmp_path / "report").mkdir()
    for name in ("gains.csv", "evaluation.png", "mine.txt"):
        (tmp_path / "report" / name).touch()
    page_of(tmp_path, tmp_path / "eval")
    assert {path.name for path in (tmp_path / "report").iterdir()} == {
        "index.html",
        "independent.csv",
        "mine.txt",
    }


def test_only_videos_below_the_folders_are_embedded(tmp_path):
    secret = tmp_path / "secret.mp4"
    secret.write_bytes(b"secret video")
    evaluation = write_evaluation(tmp_path / "eval", "me/a", tasks=["1100"]) / "independent_held_out"
    named = [{"path": path} for path in ("/etc/passwd", "../../secret.mp4", str(secret))]
    results = json.loads((evaluation / "results.json").read_text()) | {"videos": named}
    (evaluation / "results.json").write_text(json.dumps(results))
    (evaluation / "videos").mkdir()
    (evaluation / "videos/own.mp4").write_bytes(b"own video")
    (evaluation / "videos/link.mp4").symlink_to(secret)
    elsewhere = write_evaluation(tmp_path / "linked", "me/b", tasks=["1100"]) / "independent_held_out/videos"
    elsewhere.symlink_to(tmp_path)
    page = page_of(tmp_path, evaluation.parent, tmp_path / "linked")
    videos = re.findall(r'src="data:video/mp4;base64,(.*?)"', page)
    assert {base64.b64decode(video) for video in videos} == {b"own video"}
    assert "secret" not in page.replace("/secret.mp4 ", "")


def test_names_from_files_are_escaped(tmp_path):
    attack = "<script>alert(1)</script> $x_$"
    run = write_training_run(tmp_path / attack.replace("/", "_"), config={"job_name": attack, "seed": attack})
    edit_lines(run, lambda lines: [line["interventions_by_kind"].update({attack: 1}) for line in lines])
    write_evaluation(tmp_path / "eval", attack, chains=[[1, 2]])
    page = page_of(tmp_path, tmp_path, title=attack)
    assert "<script" not in page
    assert "&lt;script&gt;" in page


def test_large_videos_are_linked(tmp_path, monkeypatch):
    monkeypatch.setattr("cronos_lerobot.report.page.MAX_VIDEO_BYTES", 4)
    write_evaluation(tmp_path / "eval #1", "me/a", tasks=BEFORE, video=b"large")
    page = page_of(tmp_path, tmp_path / "eval #1")
    # A browser takes what follows a bare # for a place on the page.
    assert 'href="../eval%20%231/independent_held_out/videos/own.mp4"' in page
    assert "data:video" not in page


def test_more_videos_are_shown(tmp_path):
    run = write_evaluation(tmp_path / "run", "me/a", tasks=BEFORE)
    (tmp_path / "film.mp4").write_bytes(b"film")
    assert base64.b64encode(b"film").decode() in page_of(tmp_path, run, videos=[tmp_path / "film.mp4"])
    with pytest.raises(FileNotFoundError, match="none"):
        make_report([run], videos=[tmp_path / "none.mp4"])


def test_command_line(tmp_path, monkeypatch, capsys):
    write_evaluation(tmp_path / "eval", "me/a", tasks=BEFORE)
    write_training_run(tmp_path / "damaged")
    (tmp_path / "damaged/metrics.jsonl").write_text("")
    sides = ["--before", str(tmp_path / "eval"), "--after", str(tmp_path / "eval")]
    monkeypatch.setattr(sys, "argv", ["cronos-report", str(tmp_path), *sides, f"--output={tmp_path / 'out'}"])
    main()
    captured = capsys.readouterr()
    assert f"Report: {tmp_path / 'out' / 'index.html'}" in captured.out
    assert "all tasks" in captured.out
    assert "left out: " in captured.err
    assert "metrics.jsonl has no record" in (tmp_path / "out/index.html").read_text()
    (tmp_path / "page").touch()
    for wrong in ([str(tmp_path / "no")], [str(tmp_path / "eval"), f"--output={tmp_path / 'page/below'}"]):
        monkeypatch.setattr(sys, "argv", ["cronos-report", *wrong])
        with pytest.raises(SystemExit, match="error: "):
            main()
