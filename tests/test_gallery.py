"""Scenes of the gallery: each one runs at a tiny size, and what its words promise is so."""

import inspect
import math
import re

import numpy as np
import pytest

import pbng
from pbng.gallery import SCENES, find, gravity
from pbng.gallery.motion import Eased
from pbng.gallery.recipe import Recipe

TINY = {"resolutions": 8, "hanging_bar": 3, "bent_surface": 12}
# The others touch something, or are cloth: test_gallery_contact.py.
PLAIN = [
    *("twisting_block", "resolutions", "constitutive_models", "hanging_bar"),
    *("two_blocks_hanging", "swinging_block", "bent_surface"),
]


@pytest.mark.parametrize("name", PLAIN)
def test_first_frames_of_every_scene_converge(name):
    recipe = SCENES[name](resolution=TINY.get(name, 4))
    motion = {"inertia": recipe.inertia, "dt": recipe.dt, "substeps": recipe.substeps}
    frames = list(pbng.simulate(recipe.scene, recipe.solver, recipe.budget, frames=3, fps=recipe.fps, **motion))
    # What does not move is at rest from the second frame on: rounding is all that is left to see there.
    solved = frames[1:] if recipe.inertia else frames[: recipe.frames]
    assert {f.result.status for f in solved} == {pbng.Status.CONVERGED}
    assert all(f.result.inverted == 0 for f in frames)
    assert recipe.scene.name == name
    moved = frames[2].x - (frames[0].problem.X if recipe.frames == 1 else frames[0].x)
    assert np.abs(moved).max() > 1e-4, "nothing would be seen to happen"


@pytest.mark.parametrize("name", SCENES)
def test_entry_tells_the_default_resolution(name):
    function = getattr(pbng.gallery, name)
    default = inspect.signature(function).parameters["resolution"].default
    assert int(re.findall(r"\d+", SCENES[name].resolution)[-1]) == default
    assert SCENES[name].takes_surface == ("surface" in inspect.signature(function).parameters)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("resolution", [1, 0, -3])
def test_resolution_too_low_is_named(name, resolution):
    with pytest.raises(pbng.InputError, match=str(resolution)):
        SCENES[name](resolution=resolution)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("resolution", ["8", 2.5, None])
def test_resolution_of_another_kind_is_named(name, resolution):
    with pytest.raises(pbng.InputError, match=f"not .*{resolution}"):
        SCENES[name](resolution=resolution)


@pytest.mark.parametrize(
    ("name", "option", "values"),
    [
        ("armadillos", "surface", (5, [1, 2])),
        ("bent_surface", "surface", (5, [1, 2])),
        ("armadillos", "bodies", (0, "2", 1.5)),
        ("armadillos", "cloth", (1, "8")),
        ("armadillos", "free_at", (-1.0, math.inf, "soon")),
        ("dropping_shapes", "shapes", (0, "3")),
        ("hanging_cloth", "k_bend", (-1.0, "stiff")),
    ],
)
def test_options_of_a_scene_are_named(name, option, values):
    for wrong in values:
        with pytest.raises(pbng.InputError, match=f"{name}: {option} must be"):
            SCENES[name](**{option: wrong})


def test_cloth_keeps_a_quarter_of_the_distance_of_its_vertices():
    from pbng.gallery import cloth

    assert cloth._thickness(1.0, 51) == pytest.approx(0.25 * 0.02)
    assert cloth._thickness(1.0, 6) == 0.01


def test_block_without_free_vertices_runs():
    recipe = find("twisting_block")(resolution=2)
    assert pbng.solve(recipe.scene, recipe.solver, recipe.budget).status is pbng.Status.CONVERGED


def test_block_ends_stretched_to_two_metres_and_twisted_by_half_a_turn():
    problem = find("twisting_block")(resolution=3).scene.compile()
    assert problem.end == pytest.approx(2.0)
    X, x = problem.X[problem.fixed], problem.prescribed(problem.end)
    low, high = X[:, 0] < 0, X[:, 0] > 0
    assert x[low, 0] == pytest.approx(-1.0)
    assert x[high, 0] == pytest.approx(1.0)
    angle = [math.atan2(*(x[side & (X[:, 1] == 0.5) & (X[:, 2] == 0)][0, [2, 1]])) for side in (low, high)]
    assert abs(angle[1] - angle[0]) == pytest.approx(math.pi)


def test_three_models_are_three():
    problem = find("constitutive_models")(resolution=3).scene.compile()
    assert [type(g.material).__name__ for g in problem.groups] == ["Corotated", "StableNeoHookean", "NeoHookean"]


@pytest.mark.parametrize("longest", [0, 1, 2])
def test_bodies_are_laid_along_x_without_mirroring(longest):
    size = np.roll([2.0, 0.6, 0.5], longest)
    mesh = pbng.shapes.box(size, 3)
    laid = gravity.laid_along_x(mesh)
    assert np.ptp(laid.X, axis=0).argmax() == 0
    assert len(laid.flipped) == 0
    assert laid.volume == pytest.approx(mesh.volume)


def test_softness_of_a_beam_is_that_of_beam_theory():
    mesh = pbng.shapes.box((2.0, 0.1, 0.1), (161, 3, 3))
    area, free, sag = 0.01, 2.0 * (1 - gravity.HELD), 2.0 * gravity.SAG
    load = gravity.DENSITY * gravity.GRAVITY * area  # N/m
    exact = load * free**4 / (8 * area**2 / (4 * math.pi) * sag)  # w = q L⁴ / 8 E I
    for end in (1, -1):
        assert gravity.softness(mesh, end) == pytest.approx(exact, rel=0.03)


def test_bodies_are_held_by_the_thick_end():
    box = pbng.shapes.box((1.0, 0.3, 0.3), (21, 5, 5), (0.0, -0.15, -0.15))
    for taper, held in ((-0.8, 0.0), (0.8, 1.0)):
        scale = 1 + taper * (box.X[:, 0] - 0.5)
        mesh = pbng.TetMesh(np.column_stack([box.X[:, 0], box.X[:, 1] * scale, box.X[:, 2] * scale]), box.cells)
        problem = gravity.bent_surface(mesh).scene.compile()
        assert np.abs(problem.X[problem.fixed, 0] - held).max() <= gravity.HELD + 1e-9


def test_bent_surface_reads_files(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("igl")
    file = tmp_path / "bar.obj"
    trimesh.creation.box((0.2, 1.0, 0.2)).export(file)
    body = find("bent_surface")(surface=file, resolution=8).scene.bodies[0]
    assert body.mesh.skin is not None
    assert np.ptp(body.mesh.X, axis=0).argmax() == 0
    with pytest.raises(pbng.InputError, match=r"nothing\.obj"):
        find("bent_surface")(surface=tmp_path / "nothing.obj")


def test_eased_motion_begins_and_ends_where_the_motion_does():
    X, motion = np.eye(3), pbng.Translate((1.0, 2.0, 3.0))
    center = X.mean(0)
    for s in (0.0, 0.5, 1.0):
        assert Eased(motion).at(X, center, s, 0.0) == pytest.approx(motion.at(X, center, s, 0.0))
    slow = Eased(motion).at(X, center, 0.01, 0.0) - X
    assert np.abs(slow).max() < 1e-3


def test_recipe_refuses_what_it_cannot_run():
    scene = pbng.Scene()
    for name, values in {
        "scene": (3,),
        "frames": (0, 2.5, "3"),
        "fps": (0.0, math.inf, math.nan, "fast"),
        "substeps": (0, -3, 2.5, "2"),
        "dt": (0.0, -1.0, math.nan),
        "solver": (3, pbng.PBNG),
        "budget": (3, None),
    }.items():
        for wrong in values:
            with pytest.raises(pbng.InputError, match=f"Recipe: {name} must be"):
                Recipe(**{"scene": scene, name: wrong})
    with pytest.raises(pbng.InputError, match="dt or substeps, not both"):
        Recipe(scene, inertia=True, dt=0.01, substeps=2)
    assert Recipe(scene, frames=np.int64(3), fps=24, dt=0.01).fps == 24.0


def test_unknown_scene_names_its_neighbours():
    with pytest.raises(pbng.InputError, match="twisting_block"):
        find("twistingblock")
    with pytest.raises(pbng.InputError, match="hanging_bar"):
        find("zzz")


@pytest.mark.parametrize("name", PLAIN)
def test_newton_and_pbng_agree(name):
    """The same equilibrium to 1e-6 of the size; where a motion goes far in one step there may be several."""
    problem = SCENES[name](resolution=TINY.get(name, 5)).scene.compile()
    size = np.ptp(problem.X, axis=0).max()
    budget = pbng.Budget(atol=1e-7 * np.linalg.norm(problem.f_ext) + 1e-9, iterations=300)
    solvers = pbng.Newton(), pbng.MultigridPBNG()
    newton, ours = (pbng.solve(problem, solver, budget, at=0.3 * problem.end) for solver in solvers)
    assert newton.status is pbng.Status.CONVERGED
    assert ours.status is pbng.Status.CONVERGED
    assert np.abs(newton.x - ours.x).max() < 1e-6 * size
