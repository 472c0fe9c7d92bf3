"""Meshes from surfaces: tets that fill a solid and carry its surface, and a creature to try them on."""

from pbng.meshing.creature import creature
from pbng.meshing.embedding import embed
from pbng.meshing.stuffing import stuff
from pbng.meshing.tetrahedralize import tetrahedralize

__all__ = ["creature", "embed", "stuff", "tetrahedralize"]
