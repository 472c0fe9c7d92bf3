"""Equilibria of soft bodies and cloth by position-based nonlinear Gauss-Seidel.

Public names are loaded on first use, so that ``import pbng`` and the command line start at once.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0.dev0"

_HOME = {
    "pbng.errors": ["InputError"],
    "pbng.mesh": ["Embedding", "TetMesh", "TriMesh"],
    "pbng.quality": ["quality"],
    "pbng.meshing": ["creature", "tetrahedralize"],
    "pbng.io.meshes": ["read_mesh", "read_surface"],
    "pbng.io.frames": ["FrameWriter", "read_run"],
    "pbng.io.export": ["export"],
    "pbng.materials.base": ["Block", "Material", "material"],
    "pbng.materials.corotated": ["Corotated"],
    "pbng.materials.neo_hookean": ["NeoHookean"],
    "pbng.materials.stable_neo_hookean": ["StableNeoHookean"],
    "pbng.materials.linear": ["LinearElastic"],
    "pbng.materials.check": ["check_material"],
    "pbng.motions": ["Animation", "Motion", "Rotate", "Scale", "Translate"],
    "pbng.scene": ["Body", "Scene", "Selection"],
    "pbng.problem": ["Problem"],
    "pbng.simulate": ["Frame", "simulate", "solve"],
    "pbng.solvers.base": ["Budget", "Progress", "Result", "Status"],
    "pbng.solvers.acceleration": ["SOR", "Anderson", "Chebyshev", "NodeSOR"],
    "pbng.solvers.pbng": ["PBNG"],
    "pbng.view": ["view"],
}
_MODULES = ["linalg", "shapes", "gallery"]
_WHERE = {name: home for home, names in _HOME.items() for name in names}

__all__ = sorted([*_WHERE, *_MODULES])


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"pbng.{name}")
    if name not in _WHERE:
        raise AttributeError(f"module 'pbng' has no attribute {name!r}")
    value = getattr(import_module(_WHERE[name]), name)
    globals()[name] = value  # a submodule of the same name must not shadow it
    return value


def __dir__() -> list[str]:
    return __all__
