"""Starts on paper and as pictures: true size, the right way round, sheets that fit together."""

import re
import sys

import matplotlib as mpl
import numpy as np
import pytest
from lerobot_env_cronos import get_scene, load_benchmark
from PIL import Image

from cronos_lerobot.film.starts import find_outlines, write_sheets
from cronos_lerobot.scripts import report

MM = 25.4 / 72
"""Of a PDF's unit."""
UPRIGHT, ACROSS = (1, 0, 0, 0), (np.sqrt(0.5), 0, 0, np.sqrt(0.5))


def poses_at(*places):
    return np.array([(x, y, 0.02, *turn) for x, y, turn in places], dtype=float)


def paths_in(pdf):
    """The outlines on the pages of an uncompressed PDF: points (n, 2) [mm] from the lower left corner."""
    drawn = re.findall(r"((?:[-\d.]+ [-\d.]+ m\n)(?:[-\d.]+ [-\d.]+ l\n)+)h", pdf.read_bytes().decode("latin-1"))
    return [np.array(re.findall(r"([-\d.]+) ([-\d.]+) [ml]", path), float) * MM for path in drawn]


def test_outlines_in_the_pdf_are_as_large_and_as_far_apart_as_the_things(tmp_path):
    scene = get_scene("so101_desk_2x2")
    # Cube, marker along x, box lid and plate: so close to the arm that one sheet holds them.
    places = (0.10, 0.03, UPRIGHT), (0.10, -0.03, ACROSS), (0.08, 0, UPRIGHT), (0.08, 0, UPRIGHT)
    with mpl.rc_context({"pdf.compression": 0}):
        pages = write_sheets(
            tmp_path / "start.pdf", "", find_outlines(scene, poses_at(*places)), Image.new("L", (4, 3))
        )
    assert len(pages) == 2
    boxes = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "start.pdf").read_bytes())
    np.testing.assert_allclose(np.array(boxes, float) * MM, [(210, 297)] * 2, atol=0.01)
    sizes = {tuple(np.ptp(path, axis=0).round(1)): path for path in paths_in(tmp_path / "start.pdf")}
    cube, marker, lid, plate = (sizes[size] for size in ((25, 25), (15, 120), (85, 105), (100, 100)))
    assert [len(path) for path in (cube, marker, lid, plate)] == [4, 4, 4, 72]
    middle = {
        name: (path.min(axis=0) + path.max(axis=0)) / 2
        for name, path in (("cube", cube), ("marker", marker), ("plate", plate))
    }
    np.testing.assert_allclose(middle["cube"] - middle["marker"], (60, 0), atol=0.05)
    np.testing.assert_allclose(middle["plate"] - middle["cube"], (-30, 20), atol=0.05)
    ruler = [path for path in (line.get_xydata() for line in pages[1].axes[1].lines) if np.ptp(path[:, 0]) == 100]
    assert len(ruler) == 1
    # The axes that have the ruler cover the page, a unit a millimetre.
    np.testing.assert_allclose(pages[1].axes[1].get_window_extent().size / pages[1].dpi * 25.4, (210, 297))


def test_the_foot_of_the_arm_and_arrows_are_where_they_belong():
    base, _, shovel, *_ = find_outlines(
        get_scene("kitchen_2x2"),
        poses_at((0.3, 0.1, UPRIGHT), (0.3, -0.1, ACROSS), (0.2, 0.1, UPRIGHT), (0.2, -0.1, UPRIGHT)),
    )
    corners = np.concatenate(shovel.polygons)
    np.testing.assert_allclose(np.ptp(corners, axis=0), (148.8, 57.1)[::-1], atol=0.01)
    np.testing.assert_allclose((corners.min(axis=0) + corners.max(axis=0)) / 2, (-100, -300), atol=0.01)
    # Its handle is at +y, which a quarter turn brings to -x: up the page. The blade is the wider part.
    np.testing.assert_allclose(shovel.heading, (0, 74.4), atol=0.01)
    blade = max(shovel.polygons, key=lambda polygon: np.ptp(polygon[:, 0]))
    assert blade[:, 1].mean() < -300
    (foot,) = base.polygons
    assert (foot.min(axis=0) < 0).all()
    assert (foot.max(axis=0) > 0).all()
    assert base.heading is None
    so101 = find_outlines(
        get_scene("so101_desk_2x2"), load_benchmark(None, "so101_desk_2x2").configurations["train"][0]
    )
    # From the foot's corners in `looks.py`: 111 mm wide and 87 mm deep, and 26 mm of it before the pan axis.
    np.testing.assert_allclose(np.ptp(so101[0].polygons[0], axis=0), (111, 87), atol=0.1)
    assert so101[0].polygons[0][:, 1].min() == pytest.approx(-25.8, abs=0.1)
    assert [outline.name for outline in so101 if outline.heading is None] == ["base of the arm", "plate"]


def test_command_draws_starts_whose_sheets_fit_together(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr("cronos_lerobot.film.starts.write_sheets", lambda *args: kept.append(write_sheets(*args)))
    command = ["cronos-report", "starts", "--scene=so101_desk_2x2", f"--output={tmp_path}", "--starts"]
    monkeypatch.setattr(sys, "argv", [*command, "0"])
    report.main()
    assert {path.name for path in tmp_path.iterdir()} == {"train_00.png", "train_00.pdf"}
    # Red is the cube, and its name is below it.
    picture = np.asarray(Image.open(tmp_path / "train_00.png")).astype(int)
    assert picture.shape == (720, 960, 3)
    rows, columns = np.nonzero((picture[..., 0] > 150) & (picture[..., 1:].max(axis=2) < 80))
    below = picture[rows.max() + 2 : rows.max() + 30, int(columns.mean()) - 30 : int(columns.mean()) + 30]
    assert (below.max(axis=2) < 30).sum() > 20
    _, *sheets = kept[0]
    assert len(sheets) == 4
    spans = np.array([(sheet.axes[0].get_xlim(), sheet.axes[0].get_ylim()) for sheet in sheets])
    for sheet, span in zip(sheets, spans, strict=True):
        drawn = sheet.axes[0].get_window_extent()
        np.testing.assert_allclose(drawn.size / sheet.dpi * 25.4, np.ptp(span, axis=1))
        np.testing.assert_allclose(drawn.min / sheet.dpi * 25.4, (12, 12))
    # A1 A2 / B1 B2: each begins where its neighbour ends.
    np.testing.assert_allclose(spans[0, 0, 1], spans[1, 0, 0])
    np.testing.assert_allclose(spans[0, 1, 0], spans[2, 1, 1])
    monkeypatch.setattr(sys, "argv", [*command, "64"])
    with pytest.raises(SystemExit, match="no start 64; valid: 0 to 63"):
        report.main()
