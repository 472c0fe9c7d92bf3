"""The course of examples: each runs, and returns the one number that physics says it must."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples"

# Name, the number, how far from it is allowed, what the example writes, and the optional packages it needs.
COURSE = [
    ("01_twist_a_block", 45.0, 0.1, ["twist"], []),  # degrees; exact by symmetry
    ("02_one_equilibrium", 1.0205, 0.005, [], []),  # more than 1, the clamps hinder contraction
    ("03_beam_under_gravity", 1.0, 0.01, [], []),
    ("04_a_material_of_ones_own", 1.0, 1e-3, [], []),
    ("05_materials_and_bodies", 1.0, 1e-3, [], []),
    ("06_from_a_surface", 1.0, 0.01, ["dragon.png"], ["igl", "pyvista"]),
    ("07_plane_strain", 1.0, 0.003, [], []),
    ("08_accelerations", 8.0, 3.5, ["residuals.png"], ["matplotlib"]),  # sweeps over sweeps
    ("09_labels_to_trust", 1.0, 0.0, [], []),  # all of them
    ("10_springs", 1.0, 0.01, [], []),
    ("11_motion", 1.0, 1e-3, [], []),
    ("12_cloth", 1.0, 5e-3, [], []),
    ("13_contact", 1.0, 0.01, [], []),
    ("14_cloth_on_a_body", 1.0, 0.03, ["blanket.png"], ["pyvista"]),
]


@pytest.mark.parametrize(("name", "number", "allowed", "written", "needed"), COURSE, ids=[c[0] for c in COURSE])
def test_example(name, number, allowed, written, needed, tmp_path, monkeypatch):
    missing = [package for package in needed if find_spec(package) is None]
    if missing:
        pytest.skip(f"needs {', '.join(missing)}")
    given, elsewhere = tmp_path / "given", tmp_path / "elsewhere"
    given.mkdir()
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    monkeypatch.syspath_prepend(FOLDER)
    assert import_module(name).main(given) == pytest.approx(number, abs=allowed)
    assert sorted(path.name for path in given.iterdir()) == written
    assert not list(elsewhere.iterdir())


def test_every_example_is_run():
    assert sorted(path.stem for path in FOLDER.glob("[0-9]*.py")) == [c[0] for c in COURSE]
