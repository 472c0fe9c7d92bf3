"""Figs. 7 to 11 and Tables 2 to 4 at their small size: rows, pictures, and the claims that hold on a small block too.

Times mean nothing at this size, so that no test reads them.
"""

import json

import numpy as np
import pytest

pytest.importorskip("pyvista")
pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

from pbng.reproduce import find  # noqa: E402
from pbng.reproduce.linear import told_above  # noqa: E402
from pbng.reproduce.section import Settings  # noqa: E402
from pbng.reproduce.twisting import Pace, block, frames_at, length, listed, ms  # noqa: E402

NAMES = ("fig7", "fig8", "fig9", "fig10", "fig11", "table2", "table3", "table4")


@pytest.fixture(scope="module")
def sections(tmp_path_factory):
    done = {}

    def section(name):
        if name not in done:
            done[name] = find(name)(Settings(tmp_path_factory.mktemp(name), "small"))
        return done[name]

    return section


@pytest.mark.parametrize("name", NAMES)
def test_rows_words_and_pictures(sections, name):
    section = sections(name)
    assert section.name == name
    assert section.rows
    assert all(row.what and (row.ours or "not in the gallery" in row.remark) for row in section.rows)
    assert section.found.endswith(".")
    assert "nan" not in section.found
    assert "None" not in section.found
    json.dumps(dict(section.record), allow_nan=False)
    for picture in section.pictures:
        with Image.open(picture.path) as image:
            assert np.ptp(np.asarray(image.convert("L"))) > 100
    assert len(section.pictures) == {"fig7": 4, "fig8": 1, "fig9": 2, "fig10": 2, "fig11": 2}.get(name, 0)


def test_pbng_converges_in_the_big_budget_and_pbd_does_not(sections):
    big = sections("fig7").record["outcomes"]["big"]
    assert max(big["PBNG"]["ratios"]) < 0.1 * min(big["PBD"]["ratios"])
    assert not big["PBNG"]["lost"]
    assert big["PBNG"]["inverted"][-1] == 0
    assert max(big["PBNG"]["errors"].values()) < 0.1 * max(big["XPBD-QS"]["errors"].values())


def test_methods_have_equal_seconds_but_for_one_iteration(sections):
    for level, count in (("low", 6), ("big", 40)):
        outcomes = sections("fig7").record["outcomes"][level]
        assert outcomes["PBNG"]["iterations"] == count
        for label, outcome in outcomes.items():
            within = outcome["seconds"] <= 1.06 * outcomes["PBNG"]["seconds"]
            assert within or outcome["iterations"] == 1 or label in ("PBNG", "Newton, the paper's")


def test_newton_at_its_best_inverts_nothing(sections):
    for each in sections("fig7").record["outcomes"].values():
        assert max(each["Newton at its best"]["inverted"]) == 0
        assert not each["Newton at its best"]["lost"]


def test_levels_and_models_come_close_to_their_equilibria(sections):
    assert all(level["error"] < 1e-3 and level["inverted"] == 0 for level in sections("fig8").record["levels"])
    runs = sections("fig9").record["runs"]
    assert len(runs) == 6
    assert all(run["error"] < 1e-2 and not run["lost"] for run in runs.values())


def test_pbng_with_anderson_leaves_less_than_linear_gauss_seidel(sections):
    for runs in sections("fig10").record["runs"].values():
        assert runs["PBNG with Anderson"]["ratio"] < runs["Newton + linear GS"]["ratio"]


def test_the_exact_hessian_breaks_down_in_one_large_step_and_pbng_does_not(sections):
    runs = sections("fig11").record["runs"]
    fine, once = runs["8"], runs["1"]
    exact = ("exact, direct", "exact, BiCGSTAB", "exact, linear GS")
    assert not any(told["lost"] for told in fine.values())
    assert any(once[k]["lost"] or once[k]["last"] > 1 for k in exact)
    assert not once["PBNG"]["lost"]
    assert once["PBNG"]["last"] < 1


def test_pace_fits_iterations_into_seconds():
    pace = Pace(0.01, 0.002)
    assert pace.fit(0.02) == 5
    assert pace.fit(0.0) == 1
    assert pace.seconds(5) == pytest.approx(0.02)


def test_words():
    assert listed(["a"]) == "a"
    assert listed(["a", "b", "c"]) == "a, b and c"
    assert ms(0.17) == "170 ms"
    assert ms(1.3) == "1.30 s"
    assert ms(61) == "61 s"
    assert length(0.012) == "12 mm"
    assert length(0.12) == "0.12 m"
    assert told_above(None, 1.0)
    assert told_above(2.0, 1.0)
    assert not told_above(1.0, None)


def test_blocks_of_other_models_have_the_same_mesh():
    from pbng.materials.neo_hookean import NeoHookean

    corotated, other = block(4), block(4, NeoHookean)
    assert (corotated.X == other.X).all()
    assert type(other.groups[0].material) is NeoHookean
    assert (corotated.mass == other.mass).all()
    assert frames_at(7.5) == 16
