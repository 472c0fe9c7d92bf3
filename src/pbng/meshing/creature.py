"""The little dragon that examples and tests use as a body of no particular shape."""

from importlib import resources

import numpy as np

from pbng.mesh import TriMesh


def creature() -> TriMesh:
    """Surface of a little dragon: closed, of genus 0, 7,002 vertices and 14,000 triangles.

    It is 1 m long, stands on y = 0, looks along +x and is symmetric about z = 0; seen from +z it walks to the right.
    Modelled for this package by ``benchmarks/make_creature.py``; fill it with :func:`pbng.meshing.tetrahedralize`.
    """
    with resources.files("pbng").joinpath("data/creature.npz").open("rb") as file, np.load(file) as data:
        return TriMesh(data["X"], data["cells"])
