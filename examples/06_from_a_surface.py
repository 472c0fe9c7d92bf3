"""6. From a surface to tets, bent and drawn. Needs pbng[mesh] and pbng[view].

A closed surface, here the dragon that comes with the package, is filled with tets, which carry it as their skin. Its
rear is held and its head is raised. The material is nearly incompressible, so the volume hardly changes.

Usage: python examples/06_from_a_surface.py [folder]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import pbng


def main(folder=None, cell=0.05):
    """Returns the volume of the bent body over that at rest."""
    folder = Path(folder or tempfile.mkdtemp(prefix="pbng-"))
    mesh = pbng.tetrahedralize(pbng.creature(), cell=cell)  # or pbng.read_surface("my.obj")
    print(pbng.quality(mesh))

    scene = pbng.Scene()
    body = scene.add(mesh, pbng.Corotated(E=1e5, nu=0.45), name="dragon")
    low, high = mesh.X[:, 0].min(), mesh.X[:, 0].max()  # its length is along x
    scene.pin(body.where(x=(low, 0.6 * low + 0.4 * high)))
    scene.move(body.where(x=(0.2 * low + 0.8 * high, high)), pbng.Rotate("z", turns=0.15), over=1.0)
    *_, last = pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-3, iterations=300), frames=6, fps=5)
    print(f"{last.result.status} Inverted tets: {last.result.inverted}.")

    print("picture:", pbng.view.picture(last, folder / "dragon.png", size=(640, 480)))
    edges = last.x[mesh.cells[:, 1:]] - last.x[mesh.cells[:, :1]]
    return float(np.linalg.det(edges).sum() / 6 / mesh.volume.sum())


if __name__ == "__main__":
    print(f"volume ratio = {main(*sys.argv[1:]):.4f}")
