"""``pbng reproduce fig19``: the claims, from the record of a small run, and its words for other outcomes."""

import json
import re

import matplotlib.image
import numpy as np
import pytest

from pbng import reproduce
from pbng.gallery import SCENES
from pbng.reproduce import EXPERIMENTS, cloth
from pbng.reproduce.section import Settings


@pytest.fixture(scope="module")
def section(tmp_path_factory):
    return reproduce.find("fig19")(Settings(tmp_path_factory.mktemp("fig19"), "small", threads=1))


def test_section(section):
    assert section.name == "fig19"
    assert section.found.endswith(".")
    assert "  " not in section.found + section.scene
    assert all(row.what and row.ours for row in section.rows)
    assert not re.search(r"\bnan\b|\binf\b|None", " ".join([section.found, *(r.ours + r.remark for r in section.rows)]))
    json.dumps(section.record, allow_nan=False)
    for picture in section.pictures:
        image = matplotlib.image.imread(picture.path)[..., :3]
        assert min(image.shape[:2]) > 200
        assert image.std() > 0.02
    assert len(section.pictures) == 2


def test_budgets_are_the_papers(section):
    record = section.record
    assert (record["substeps"], record["sweeps"]) == (7, 44)  # steps of 1/210 s, where the paper has 0.005 s
    assert {record["iterations"][name] for name in cloth.SWEEPS} == {7 * 44}
    assert record["iterations"][cloth.CYCLE] == 7
    assert all(s > 0 for s in record["seconds"].values())


def test_coarse_cloth_is_solved_by_all(section):
    """The coarser the cloth, the fewer sweeps it takes: here nothing is too stretchy, and all are near exact steps."""
    assert all(max(d) < 0.01 for d in section.record["stretch"].values())
    assert all(max(d) < 0.01 for d in section.record["away"].values())
    assert "Not one is visibly stretchier" in section.found
    assert "coarser than the paper's" in section.found


def test_words_follow_from_the_numbers(section, tmp_path):
    names = [*cloth.SWEEPS, cloth.CYCLE, cloth.CONVERGED]
    swings = {name: cloth.Swing(np.zeros((2, 1, 3)), 0.1, 308) for name in names}
    away = {name: np.array([0.0, 0.05]) for name in names} | {"PBNG, plain": np.array([0.1, 0.9])}
    stretch = {name: np.array([0.0, 0.001]) for name in names} | {"PBNG, plain": np.array([0.01, 0.04])}
    told = cloth._found(swings, away, stretch, Settings(tmp_path, "medium"))
    assert told.startswith("Too stretchy: PBNG, plain by 4.0 % more than exact steps.")
    assert "PBNG, SOR (50 mm), PBNG (50 mm) and two-grid, 1 cycle (50 mm): no farther from exact steps" in told
    assert "PBNG, plain (0.9 m): farther from them than steps solved to 1e-3 are" in told


def test_stretch_is_the_mean_over_edges():
    problem = SCENES["hanging_cloth"](resolution=3).scene.compile()
    x = np.array([problem.X, 1.5 * problem.X + 1.0])
    np.testing.assert_allclose(cloth.stretches(problem, x), [1.0, 1.5])


def test_figures_of_the_gallery_can_be_reproduced():
    """What ``pbng list`` names a figure for, ``pbng reproduce`` knows."""
    figures = {entry.figure.replace("Fig. ", "fig") for entry in SCENES.values() if entry.figure}
    assert figures <= set(EXPERIMENTS)
