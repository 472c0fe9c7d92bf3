"""``pbng reproduce``: the claims of the paper, from the records of small runs, and the page that tells of them."""

import base64
import json
import re

import matplotlib.image
import numpy as np
import pytest
from typer.testing import CliRunner

import pbng
from pbng import reproduce
from pbng.bench.scenes import box, hard_start
from pbng.cli import app
from pbng.coloring import color_constraints
from pbng.errors import InputError
from pbng.reproduce import page
from pbng.reproduce.colors import PAPER
from pbng.reproduce.common import first_below, settled
from pbng.reproduce.section import Settings

NAMES = ("fig3", "fig12", "fig17", "fig18", "table1")


@pytest.fixture(scope="module")
def section(tmp_path_factory):
    """Runs an experiment, small, once."""
    done = {}

    def run(name):
        if name not in done:
            done[name] = reproduce.find(name)(Settings(tmp_path_factory.mktemp(name), "small", threads=1))
        return done[name]

    return run


def curves(section, part=None):
    """Method -> its curve, as arrays."""
    record = section.record if part is None else section.record[part]
    out = {}
    for m in record["methods"]:
        out[m["method"]] = {k: np.array(v, float) for k, v in m["curve"].items()}
    return out


@pytest.mark.parametrize("name", NAMES)
def test_section(section, name):
    s = section(name)
    assert s.name == name
    assert s.title
    assert s.scene
    assert s.claim
    assert s.found.endswith(".")
    assert s.rows
    assert all(row.what and row.ours for row in s.rows)
    assert not re.search(r"\bnan\b|\binf\b|None", " ".join([s.found, *(r.ours + r.remark for r in s.rows)]))
    json.dumps(s.record, allow_nan=False)
    assert bool(s.pictures) == (name != "table1")
    for picture in s.pictures:
        image = matplotlib.image.imread(picture.path)[..., :3]
        assert min(image.shape[:2]) > 200
        assert image.std() > 0.02  # not blank
        assert image[[0, -1]].mean() > 0.9  # on a light ground, with no frame around it
        assert picture.caption.endswith(".")


def test_page_holds_everything(section, tmp_path):
    sections = [section(name) for name in NAMES]
    text = page.write(sections, tmp_path / "index.html", {"cpu": "some <cpu>"}).read_text()
    assert "some &lt;cpu&gt;" in text
    for s in sections:
        assert f'<h2 id="{s.name}">' in text or f"<h2 id={s.name}>" in text
        for picture in s.pictures:
            assert base64.b64encode(picture.path.read_bytes()).decode() in text
    assert text.count("<tr>") == sum(len(s.rows) + 1 for s in sections)


# Fig. 3.


def test_xpbd_stagnates_where_pbng_reaches_the_tolerance(section):
    record = section("fig3").record
    for name, step in record["step"].items():
        ratio = step["residual"][-1] / step["residual"][0]
        assert (ratio <= record["tolerance"]) == (not name.startswith("XPBD"))
        assert record["stagnates"][name] == name.startswith("XPBD")
    ends = {step["residual"][-1] for name, step in record["step"].items() if name.startswith("XPBD")}
    assert len(ends) == 3  # the orders of the constraints differ, and so do the states they end in
    assert len(record["step"]["PBNG"]["residual"]) < len(record["step"]["PBNG, plain"]["residual"])
    assert max(record["away"]["PBNG"]) < 0.01 * max(record["away"]["XPBD"])
    assert max(record["away"]["XPBD, substeps"]) < max(record["away"]["XPBD"])
    assert "claim holds" in section("fig3").found


# Fig. 12.


def test_accelerations_accelerate(section):
    for start in ("first step", "hard start"):
        found = curves(section("fig12"), start)
        first = section("fig12").record[start]["first_residual"]

        def to(name, level, found=found, first=first):
            at = first_below(found[name]["iterations"], found[name]["residuals"] / first, level)
            return at or np.inf

        for name in ("Chebyshev", "SOR as printed", "node SOR", "Anderson"):
            assert to(name, 1e-3) < to("plain", 1e-3)
        assert to("Anderson", 1e-3) < to("Chebyshev", 1e-3)
        assert to("two-grid", 1e-3) <= 5


# Fig. 17.


def test_xpbd_qs_depends_on_the_order(section):
    record = section("fig17").record
    looks, weight = record["looks"], record["weight"]
    true = looks["equilibrium"]["layer"]
    assert true < 1.1
    assert looks["XPBD-QS, 1/30 s, 1 it."]["layer"] > 1.2 * true
    assert looks["XPBD-QS, 1/30 s, 1 it."]["gap"] < 1e-3
    assert looks["XPBD-QS flipped, 1/30 s, 1 it."]["layer"] < true
    assert looks["XPBD-QS flipped, 1/30 s, 1 it."]["gap"] > 0.1
    for name in ("PBNG", "two-grid", "Newton"):
        assert looks[name]["layer"] == pytest.approx(true, abs=1e-4)
        assert looks[name]["gap"] < 1e-6
    for name, curve in curves(section("fig17")).items():
        converged = name in ("PBNG", "two-grid", "Newton")
        assert (curve["residuals"][-1] < 1e-6 * weight) == converged
        if name.endswith("10 it."):  # whole pseudo-time steps
            assert not (curve["iterations"] % 10).any()
    assert curves(section("fig17"))["PBNG, no compounds"]["errors"][-1] > 0.05


# Fig. 18.


def test_pbd_loses_gravity_and_xpbd_qs_tends_to_the_truth(section):
    record = section("fig18").record
    rest, once, sag = (*(list(record["PBD"][k].values()) for k in ("at rest", "one step")), record["sag"])
    true = sag["equilibrium"]
    assert 0.6 < true < 0.95
    assert (np.diff(rest) < 0).all()
    assert rest[-1] < 0.05 * true
    assert once[-1] < 0.2 * once[0]
    assert sag["PBNG"] == pytest.approx(true, abs=0.01)

    def error(dt, iterations):
        return abs(sag[f"XPBD-QS, {dt}, {iterations} it."] - true)

    for dt in ("1/30 s", "1/120 s"):
        assert error(dt, 10) < 0.3 * error(dt, 1)
    for iterations in (1, 10):
        assert error("1/120 s", iterations) < 0.3 * error("1/30 s", iterations)


# Table 1.


def test_colours(section):
    for n, measured in section("table1").record["measured"].items():
        assert measured["node colours"] == 5
        assert measured["constraint colours"] == {"6": 37, "8": 38}[n]
        assert all(ms > 0 for ms in measured["ms"].values())


def test_colours_of_the_paper():
    """The smallest of the paper's blocks, exactly."""
    problem = hard_start(box(16), pbng.Corotated(E=1e5, nu=0.3))
    assert (problem.n_vert, problem.n_elem) == (4096, 16875)
    constraint = color_constraints([problem.groups[0].cells], problem.n_vert)
    assert (problem.color.max() + 1, constraint.max() + 1) == (PAPER[16].node, PAPER[16].constraint) == (5, 39)


# Helpers.


def test_first_and_last_crossings():
    at, values = np.array([1, 2, 5, 9]), np.array([3.0, 0.5, 2.0, 0.1])
    assert first_below(at, values, 1.0) == 2
    assert settled(at, values, 1.0) == 9
    assert settled(at, values, 5.0) == 1
    assert settled(at, values, 0.01) is None
    assert settled(at, np.array([1.0, np.nan, 1.0, 1.0]), 2.0) == 5


# The command.


def command(text):
    result = CliRunner().invoke(app, text.split())
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, " ".join(result.output.split())


def test_command_writes_a_page_and_a_record(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, said = command("reproduce table1 --size small --threads 1 --out page")
    assert code == 0, said
    assert "8³ vertices" in said
    assert "wrote 1 sections to page/index.html" in said
    record = json.loads((tmp_path / "page" / "table1" / "record.json").read_text())
    assert record["record"]["measured"]["8"]["node colours"] == 5
    assert "table1" in (tmp_path / "page" / "index.html").read_text()
    code, said = command("reproduce table1 --size small --out page")
    assert code == 1
    assert "--overwrite" in said
    assert command("reproduce table1 --size small --threads 1 --out page --overwrite")[0] == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fig99 --size small", "'fig99'"),
        ("Fig.17x --size small", "did you mean fig17"),
        ("fig3 --size huge", "small, medium, paper, not 'huge'"),
        ("fig3 --size small --out taken", "not empty"),
        ("fig3 --size small --out file", "it is a file"),
    ],
)
def test_bad_input_is_named(tmp_path, monkeypatch, text, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    code, said = command(f"reproduce {text}")
    assert code == 1
    assert words in said
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "taken"]


def test_find():
    assert reproduce.find("fig3").name == "fig3"
    with pytest.raises(InputError, match="there are fig3"):
        reproduce.find("zzz")
