"""What is typed becomes a recipe, a solver and a budget."""

import inspect
import sys
from collections.abc import Mapping
from dataclasses import fields, replace
from difflib import get_close_matches
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from pbng.drivers import default_solver
from pbng.errors import InputError
from pbng.gallery import SCENES, find
from pbng.gallery.recipe import Recipe
from pbng.io.meshes import MESHES, SURFACES
from pbng.scene import Scene
from pbng.solvers.acceleration import SOR, Anderson, Chebyshev, NodeSOR
from pbng.solvers.base import Budget, Solver
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.newton import Newton
from pbng.solvers.pbng import PBNG
from pbng.solvers.xpbd import PBD, XPBD

ACCELERATIONS: dict[str, Any] = {
    "anderson": Anderson,
    "plain": None,
    "node-sor": NodeSOR,
    "sor": SOR,
    "chebyshev": Chebyshev,
}
METHODS: dict[str, Any] = {"multigrid": MultigridPBNG, "newton": Newton, "xpbd": XPBD, "pbd": PBD}


def recipe(target: str, surface: Path | None, resolution: int | None) -> tuple[Recipe, str, Path | None]:
    """The recipe that is meant, a name for it, and the user's file that it comes from if it does.

    Raises:
        InputError: There is no such scene or file, or it does not take what is given.
    """
    given: dict[str, Any] = {"surface": surface, "resolution": resolution}
    given = {name: value for name, value in given.items() if value is not None}
    if target.endswith(".py"):
        file = Path(target)
        return _from_file(file, given), file.stem, file
    if target not in SCENES and Path(target).suffix.lower() in MESHES + SURFACES:
        raise InputError(f"{target} is a mesh, not a scene; try: pbng run bent_surface {target}")
    entry = find(target)
    if surface is not None and not entry.takes_surface:
        takers = ", ".join(e.name for e in SCENES.values() if e.takes_surface)
        raise InputError(f"scene {entry.name!r} takes no file ({surface}); {takers} does")
    return entry(**given), entry.name, None


def _from_file(file: Path, given: Mapping[str, Any]) -> Recipe:
    """What ``scene()`` of a Python file returns; it gets the resolution and the surface if it has such parameters."""
    if not file.is_file():
        raise InputError(f"no scene file {file}: " + ("it is a folder" if file.is_dir() else "no such file"))
    spec = spec_from_file_location("pbng_scene_file", file)
    if spec is None or spec.loader is None:
        raise InputError(f"{file} is not a Python file")
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and materials look their module up
    sys.path.insert(0, str(file.parent.resolve()))
    spec.loader.exec_module(module)
    make = getattr(module, "scene", None)
    if not callable(make):
        raise InputError(f"{file} has no function scene() that returns a pbng.Scene or a pbng.gallery.Recipe")
    known = inspect.signature(make).parameters
    for name, value in given.items():
        if name not in known:
            raise InputError(f"{file}: scene() has no parameter {name!r}, so {value} cannot be given to it")
    made = make(**given)
    if isinstance(made, Scene):
        made = Recipe(made)
    if not isinstance(made, Recipe):
        raise InputError(f"{file}: scene() must return a pbng.Scene or a pbng.gallery.Recipe, not {made!r}")
    return made


def in_motion(recipe: Recipe, inertia: bool | None, dt: float | None, substeps: int | None) -> Recipe:
    """The recipe with inertia or without, and with other time steps, where they are given."""
    inertia = recipe.inertia if inertia is None else inertia
    if not inertia:
        if dt is not None or substeps is not None:
            raise InputError("--dt and --substeps are for runs with --inertia")
        return replace(recipe, inertia=False, dt=None, substeps=None)
    if dt is None and substeps is None:
        return replace(recipe, inertia=True)
    return replace(recipe, inertia=True, dt=dt, substeps=substeps)


def solver(default: Solver | None, budget: Budget, name: str | None, dtype: str | None, threads: int | None) -> Solver:
    """The solver that is named, or the recipe's, or the one that suits the budget, with the settings that are given."""
    chosen: Any = default or default_solver(budget)
    if name is not None:
        plain = name.strip().lower()
        if plain == "auto":
            chosen = default_solver(budget)
        elif plain in METHODS:
            chosen = METHODS[plain]()
        else:
            acceleration = parse_acceleration(name)
            chosen = replace(chosen if isinstance(chosen, PBNG) else PBNG(), acceleration=acceleration)
    given = {key: value for key, value in (("dtype", dtype), ("threads", threads)) if value is not None}
    if given and not isinstance(chosen, (PBNG, *METHODS.values())):
        raise InputError(f"--dtype and --threads are not for {type(chosen).__name__}, which the scene asks for")
    if "dtype" in given and not hasattr(chosen, "dtype"):
        raise InputError(f"--dtype is not for {type(chosen).__name__}, which works in float64")
    return replace(chosen, **given)


def parse_acceleration(text: str) -> Any:
    """An acceleration from its name, after which its parameters may stand in order: ``"anderson:5"``.

    Raises:
        InputError: The name is unknown, or a parameter is.
    """
    name, _, values = text.partition(":")
    name = name.strip().lower().replace("_", "-")
    if name not in ACCELERATIONS:
        near = get_close_matches(name, [*ACCELERATIONS, "auto", *METHODS], n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        known = ["auto", "multigrid", *ACCELERATIONS, *(m for m in METHODS if m != "multigrid")]
        raise InputError(f"unknown solver {text!r}; {hint}known are {', '.join(known)}")
    kind = ACCELERATIONS[name]
    words = [word for word in values.split(",") if word.strip()]
    parameters = [] if kind is None else list(fields(kind))
    if len(words) > len(parameters):
        takes = ", ".join(p.name for p in parameters) or "no parameter"
        raise InputError(f"solver {text!r}: {name} takes {takes}")
    if kind is None:
        return None
    return kind(**{p.name: _number(text, p.name, p.type, word) for p, word in zip(parameters, words)})


def _number(text: str, name: str, kind: Any, word: str) -> Any:
    try:
        return kind(word)
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise InputError(f"solver {text!r}: {name} must be {what}, not {word!r}") from None


def budget(default: Budget, **limits: float | None) -> Budget:
    """A budget of the limits that are given; if none is, the recipe's."""
    given: Any = {name: value for name, value in limits.items() if value is not None}
    return Budget(**given) if given else default
