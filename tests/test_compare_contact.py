"""Comparisons of scenes that let go, and of scenes in which things touch."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import pbng
from pbng.cli import app
from pbng.compare.contest import contest
from pbng.compare.reference import converged, touching
from pbng.compare.start import Judge, Start

NEWTON = pbng.Newton(threads=1)
TWO_GRID = pbng.MultigridPBNG(threads=1)


def test_what_is_let_go_is_free():
    """At a time after one end of a beam was let go, contest and solve come to the same equilibrium; before, as well."""
    scene = pbng.Scene(gravity=(0.0, -9.8, 0.0))
    beam = scene.add(pbng.shapes.box((1.0, 0.25, 0.25), (7, 3, 3)), pbng.Corotated(E=1e4, nu=0.3, density=10.0))
    scene.pin(beam.where(x=0.0))
    scene.pin(beam.where(x=1.0), until=0.1)
    problem = scene.compile()
    for at, held in ((0.05, 18), (0.2, 9), (None, 9)):
        found = contest(problem, {"two-grid": TWO_GRID, "newton": NEWTON}, iterations=20, at=at)
        solved = pbng.solve(problem, NEWTON, pbng.Budget(rtol=1e-9), at=at)
        assert found.problem.fixed.sum() == held
        assert found.reference.energy == pytest.approx(solved.energy, rel=1e-9)
        np.testing.assert_allclose(found.curves["newton"].x, solved.x, atol=1e-8)
        assert converged(problem, Start.of(problem, at=at)).energy == pytest.approx(solved.energy, rel=1e-9)


def test_what_nothing_holds_has_no_equilibrium():
    scene = pbng.Scene(name="loose")
    beam = scene.add(pbng.shapes.box((1.0, 0.25, 0.25), (5, 2, 2)), pbng.Corotated(E=1e4, nu=0.3))
    scene.pin(beam.where(x=0.0), until=0.1)
    problem = scene.compile()
    with pytest.raises(pbng.InputError, match=r"after t = 0\.1 s nothing holds scene 'loose': .* give a time at="):
        contest(problem, {"newton": NEWTON}, iterations=1, at=0.2)
    assert contest(problem, {"newton": NEWTON}, iterations=1, at=0.05).problem.fixed.any()


@pytest.fixture(scope="module")
def pressed():
    """Two blocks driven into each other, side by side with a plate that one of them is pressed against."""
    scene = pbng.Scene(name="pressed")
    soft = pbng.Corotated(E=1e4, nu=0.3)
    left = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), soft)
    right = scene.add(pbng.shapes.box((0.8, 0.7, 0.7), 4), soft, at=(1.02, 0.15, 0.15))
    scene.pin(left.where(x=0.0))
    scene.move(right.where(x=1.82), pbng.Translate((-0.15, 0.0, 0.0)))
    scene.collide_with(pbng.Plane((0, 1.02, 0), (0, -1, 0), motion=pbng.Translate((0, -0.1, 0)), over=1.0))
    scene.contact()
    return scene.compile()


def test_methods_are_given_what_touches_at_the_equilibrium(pressed):
    """The reference is the equilibrium with contact, methods come to it, and residuals are those of their own."""
    found = contest(pressed, {"two-grid": TWO_GRID, "mixed": pbng.PBNG(threads=1)}, iterations=300)
    contacts, reference = found.start.contacts, found.reference
    assert len(contacts.vertices) >= 9
    assert len(contacts.vertex) >= 9
    assert reference.certain
    assert reference.by == "MultigridPBNG"
    solved = pbng.solve(pressed, TWO_GRID, pbng.Budget(rtol=1e-5))
    assert np.abs(reference.x - solved.x).max() < 1e-3
    clearance = contacts.clearance(reference.x)
    assert -0.03 < clearance.min() < -1e-4  # it resists, and gives way by little
    assert ((contacts.plane * reference.x[contacts.vertex]).sum(1) - contacts.level).min() > -1e-9
    assert found.energy > reference.energy > 0
    for curve in found.curves.values():
        assert curve.errors[-1] < 1e-4
        assert curve.ratios[-1] < 1e-4
    assert found.record()["problem"]["contacts"] == len(contacts)


def test_the_measure_with_contact_is_the_methods_own(pressed):
    start = touching(pressed, Start.of(pressed))
    judge, method = Judge(pressed, start), pbng.PBNG(acceleration=None, dtype="float64", threads=1).set_up(pressed)
    start.begin(method)
    for _ in range(5):
        own, seen = method.certify(), judge.look(method.state())
        assert seen.residual == pytest.approx(own.residual, rel=1e-6)
        assert seen.energy == pytest.approx(own.energy, rel=1e-9)
        assert seen.inverted == own.inverted
        method.step()


def test_compare_leaves_out_who_knows_nothing_of_contact(tmp_path, monkeypatch):
    """Unless they were named; and the others are compared with contact."""
    monkeypatch.chdir(tmp_path)

    def compare(text):
        result = CliRunner().invoke(app, ["compare", *text.split()])
        return result.exit_code, " ".join(f"{result.output} {result.exception or ''}".split())

    scene = "squeezed_ball --resolution 4 --at 1 --iterations 30 --threads 1 --no-pictures"
    code, said = compare(scene)
    assert code == 0, said
    for name in ("newton", "xpbd"):
        assert f"left out {name}: scene 'squeezed_ball': this method knows nothing of contact" in said
    record = json.loads((tmp_path / "comparisons" / "squeezed_ball" / "record.json").read_text())
    assert [m["method"] for m in record["methods"]] == ["pbng", "multigrid"]
    assert list(record["budget"]["iterations"]) == ["pbng", "multigrid"]
    assert record["reference"]["certain"]
    assert record["problem"]["contacts"] > 0
    assert all(m["ratio"] < 0.01 for m in record["methods"])
    code, said = compare(f"{scene} --methods newton,pbng --overwrite")
    assert code == 1
    assert "newton cannot do this scene" in said
    assert "; pbng can" in said
