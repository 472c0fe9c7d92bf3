"""1. Twist a block, write the frames, read them back.

A block is held at one end; the other turns by a quarter and moves away, in one second. Each frame is the equilibrium at
its time. By symmetry the section in the middle turns by half as much: 45 degrees.

Usage: python examples/01_twist_a_block.py [folder]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import pbng


def main(folder=None, vertices=9):
    """Returns the turn of the middle section [degrees]."""
    folder = Path(folder or tempfile.mkdtemp(prefix="pbng-")) / "twist"
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box(vertices=vertices), pbng.Corotated(E=1e5, nu=0.3, density=10.0), name="block")
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.0), pbng.Rotate("x", turns=0.25) + pbng.Translate((0.5, 0.0, 0.0)), over=1.0)

    with pbng.FrameWriter(folder, fps=10, overwrite=True) as out:
        for frame in pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-3), frames=11, fps=10):
            out.write(frame)
            print(f"frame {frame.index:2d}, {frame.result.iterations} sweeps, residual {frame.result.residual:.1e} N")

    run = pbng.read_run(folder)
    print(f"{run!r} in {folder}")
    middle = block.where(x=0.5).index
    before, after = (complex_in_section(x[middle]) for x in (block.mesh.X, run[-1].x))
    return float(np.degrees(np.angle(np.vdot(before, after))))


def complex_in_section(x):
    """y + i z about the centre, so that a turn about x is a complex factor."""
    y, z = (x - x.mean(0))[:, 1:].T
    return y + 1j * z


if __name__ == "__main__":
    print(f"the middle has turned by {main(*sys.argv[1:]):.2f} degrees")
