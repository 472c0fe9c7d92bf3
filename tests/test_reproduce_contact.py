"""``pbng reproduce fig13, fig14, fig16, table3``: the claims, from the records of small runs."""

import json
import re
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest

from pbng import reproduce
from pbng.reproduce import contact
from pbng.reproduce.contact import PAPER, fall
from pbng.reproduce.section import Settings
from pbng.solvers.base import Status

NAMES = ("fig13", "fig14", "fig16", "table3")
FEW = {"fig13": 76, "fig14": 16, "fig16": 31}


@pytest.fixture(scope="module")
def section(tmp_path_factory):
    """Runs an experiment, smaller than small, once."""
    tiny = {
        "fig13": ({"resolution": 4}, FEW["fig13"]),
        "fig14": ({"resolution": 4, "shapes": 5}, FEW["fig14"]),
        "fig16": ({"resolution": 12, "bodies": 1, "cloth": 12, "free_at": 0.6}, FEW["fig16"]),
    }
    before = contact.SIZES
    contact.SIZES = {k: (scene, (tiny[k], *sizes[1:])) for k, (scene, sizes) in before.items()}
    done = {}

    def run(name):
        if name not in done:
            done[name] = reproduce.find(name)(Settings(tmp_path_factory.mktemp(name), "small", threads=1))
        return done[name]

    yield run
    contact.SIZES = before
    contact._fall.cache_clear()


@pytest.mark.parametrize("name", NAMES)
def test_section(section, name):
    s = section(name)
    assert s.name == name
    assert s.title
    assert s.scene
    assert s.claim
    assert s.found.endswith(".")
    assert "  " not in s.found + s.scene
    assert all(row.what and row.ours for row in s.rows)
    assert not re.search(r"\bnan\b|\binf\b|None", " ".join([s.found, *(r.ours + r.remark for r in s.rows)]))
    json.dumps(s.record, allow_nan=False)
    assert bool(s.pictures) == (name != "table3")
    for picture in s.pictures:
        image = matplotlib.image.imread(picture.path)[..., :3]
        assert min(image.shape[:2]) > 200
        assert image.std() > 0.02  # not blank
        assert picture.caption.endswith(".")


@pytest.mark.parametrize("name", PAPER)
def test_iterations_and_substeps_are_the_papers(section, name):
    record, paper = section(name).record, PAPER[name]
    assert record["substeps"] == paper.steps
    assert set(record["iterations"]) == {paper.iterations}
    assert len(record["seconds"]) == FEW[name] - 1
    seconds, parts = np.array(record["seconds"]), np.add(record["finding"], record["packing"])
    assert (seconds > 0).all()
    assert (parts < seconds).all()
    assert record["colors"][1] >= record["colors"][0] >= 4
    assert max(record["pairs"]) > 0
    assert max(record["deepest"]) < 0.2 * record["edge"]


def test_blocks_touch_and_part(section):
    record = section("fig13").record
    assert record["pairs"][0] == record["pairs"][-1] == 0
    assert record["inverted"][-1] == 0
    told = section("fig13").found
    assert f"up to {max(record['pairs']):,} contacts" in told
    assert "no contact is left" in told
    assert "With the paper's k_n of 1e8 N/m" in told
    stiff = record["paper_k"]
    lost = stiff["inverted"][-1] > record["tets"] / 3 or len(stiff["seconds"]) < len(record["seconds"])
    assert ("lost" in told) == lost


def test_cloth_and_bodies_are_coupled(section):
    s = section("fig16")
    assert s.record["triangles"] == 2 * 11**2
    assert "let go" in s.scene
    assert "little dragon" in s.scene


def test_table_has_the_rows_with_contact(section):
    s = section("table3")
    rows = {r.what: r for r in s.rows}
    for name, paper in PAPER.items():
        row = rows[f"{paper.label}, Corotated"]
        assert f"({paper.iterations} in {paper.steps})" in row.remark
        assert np.mean(section(name).record["seconds"]) == pytest.approx(
            next(c["seconds"] for c in s.record["contact"] if c["what"] == paper.label)
        )  # the run is the figure's
    assert "muscles" in s.found


def test_runs_are_shared(section, tmp_path):
    section("fig14")
    settings = Settings(tmp_path, "small", threads=1)
    assert fall("fig14", settings) is fall("fig14", settings)


def cut(run, frames, lost=False):
    """A run that ends after so many frames, the one at time 0 not counted; lost there, if so."""
    arrays = ("seconds", "iterations", "finding", "packing", "pairs", "walls", "deepest", "kinetic", "potential")
    last = run.frames[-1]
    if lost:
        last = replace(last, result=replace(last.result, status=Status.DIVERGED))
    short = {name: getattr(run, name)[:frames] for name in (*arrays, "inverted")}
    return replace(run, frames=(*run.frames[:-1], last), **short)


def test_frames_are_called_sound_only_if_they_are(section, tmp_path):
    """Not where tets are inverted or penetration shows, though the state is never lost."""
    section("fig14")
    settings = Settings(tmp_path, "small", threads=1)
    run = fall("fig14", settings)
    zeros = np.zeros(len(run.seconds))
    good = replace(run, inverted=zeros, deepest=zeros)
    inverted = replace(good, inverted=np.where(np.arange(len(zeros)) == 3, 132, 0))
    deep = replace(good, deepest=np.full(len(zeros), 1.8 * run.edge))
    told = [contact._robust(r, settings, "fig14") for r in (good, inverted, deep, cut(good, 9, lost=True))]
    assert told[0].startswith("All frames are sound:")
    assert "which does not show" in told[0]
    assert told[1].startswith("It runs on without being lost, but not every frame is sound:")
    assert "132 tets at most are inverted" in told[1]
    assert told[2].startswith("It runs on without being lost, but not every frame is sound:")
    assert "1.8 of an edge, which shows" in told[2]
    assert told[3].startswith("The state is lost after 0.30 s:")


def test_energies_are_compared_at_one_moment_of_both_runs(section, tmp_path):
    """That is the end of the rest, or the last frame of the run that is shorter; and it is named."""
    section("fig13")
    run = fall("fig13", Settings(tmp_path, "small", threads=1))
    kinetic = np.arange(1.0, len(run.seconds) + 1)  # number of the frame
    ours, stiff = replace(run, kinetic=kinetic), replace(run, kinetic=1000 + kinetic)
    (row,) = [r for r in contact._stiff_rows(ours, stiff) if "energy" in r.what]
    assert row.remark == "45 J with ours, at 1.50 s"  # where the ends are still held
    assert "what ought to be at rest moves, with 1e+03 J where ours has 45 J" in contact._collided(ours, stiff)
    for frames in (9, 20):  # before the blocks have come together
        (row,) = contact._stiff_rows(ours, cut(stiff, frames, lost=True))
        assert row.ours == f"{frames / 30:.2f} s"
        assert row.remark == f"the kinetic energy is 1e+03 J at {frames / 30:.2f} s, {frames} J with ours"
        assert f"lost after {frames / 30:.2f} s" in contact._collided(ours, cut(stiff, frames, lost=True))
    assert "ought to be at rest" not in contact._collided(cut(ours, 20), cut(stiff, 20))
