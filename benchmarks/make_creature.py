"""Models the little dragon of ``pbng.meshing.creature()`` and writes it to ``src/pbng/data/creature.npz``.

The dragon is an implicit surface: rounded cones and ellipsoids joined by a smooth minimum. Its half z >= 0 is
polygonised by marching cubes, simplified and mirrored, so that the surface is exactly symmetric. Run from anywhere:

    python benchmarks/make_creature.py [picture.png]

It needs libigl; the picture needs pyvista.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import igl
import numpy as np
from scipy.interpolate import CubicSpline

OUT = Path(__file__).parents[1] / "src/pbng/data/creature.npz"
N_TRIANGLES = 14_000
LENGTH = 1.0  # along x [m]; the sketch below has about this size already
SPACING = 0.006  # of the grid of marching cubes


def unit(*v: float) -> np.ndarray:
    return np.array(v) / np.linalg.norm(v)


def curve(knots: list[tuple[float, ...]], n: int) -> np.ndarray:
    """Points (n, columns) on a smooth curve through the knots."""
    return CubicSpline(np.linspace(0, 1, len(knots)), np.array(knots))(np.linspace(0, 1, n))


def ellipsoid(p, centre, radii, tilt=0.0):
    """Distance, to first order, to an ellipsoid tilted by an angle [deg] about z."""
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    q = (p - centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) / radii
    k = np.linalg.norm(q, axis=1)
    return k * (k - 1) / np.maximum(np.linalg.norm(q / radii, axis=1), 1e-9)


def cone(p, a, b, ra, rb):
    """Distance to the convex hull of two spheres, of radius ra at a and rb at b."""
    axis = np.subtract(b, a)
    length = np.linalg.norm(axis)
    q = p - a
    y = q @ axis / length
    x = np.sqrt(np.maximum((q**2).sum(1) - y**2, 0))
    sine = (ra - rb) / length
    cosine = np.sqrt(1 - sine**2)
    along = y * cosine - x * sine  # tells which is closest: a sphere or the mantle between them
    mantle = x * cosine + y * sine - ra
    return np.where(
        along < 0, np.hypot(x, y) - ra, np.where(along > length * cosine, np.hypot(x, y - length) - rb, mantle)
    )


def chain(p, joints, radii, k):
    """Smooth union of the rounded cones along a polyline."""
    d = cone(p, joints[0], joints[1], radii[0], radii[1])
    for i in range(1, len(joints) - 1):
        d = blend(d, cone(p, joints[i], joints[i + 1], radii[i], radii[i + 1]), k)
    return d


def blend(a, b, k):
    """Smooth minimum: the union of two solids, its seam rounded over a width k."""
    h = np.maximum(k - np.abs(a - b), 0) / k
    return np.minimum(a, b) - h**3 * k / 6


def carve(a, b, k):
    """What is left of solid a without b, the rim rounded over a width k."""
    return -blend(-a, b, k)


# The spine from the tip of the tail to the head: x, y, radius.
SPINE = curve(
    [
        (-0.430, 0.430, 0.030),
        (-0.520, 0.370, 0.040),
        (-0.535, 0.255, 0.054),
        (-0.430, 0.175, 0.080),
        (-0.260, 0.195, 0.120),
        (-0.070, 0.255, 0.165),
        (0.075, 0.310, 0.150),
        (0.165, 0.410, 0.112),
        (0.215, 0.520, 0.098),
        (0.250, 0.610, 0.095),
    ],
    60,
)
SMILE = curve(
    [(0.505, 0.612, 0), (0.495, 0.612, 0.045), (0.455, 0.622, 0.092), (0.400, 0.655, 0.125), (0.365, 0.692, 0.140)], 14
)


def dragon(p: np.ndarray) -> np.ndarray:
    """Signed distance, roughly, of points (n, 3) to the dragon, negative inside."""
    d = chain(p, np.insert(SPINE[:, :2], 2, 0, axis=1), SPINE[:, 2], 0.01)
    d = blend(d, ellipsoid(p, (-0.02, 0.235, 0), (0.200, 0.150, 0.170), 8), 0.06)  # belly
    d = blend(d, ellipsoid(p, (0.270, 0.690, 0), (0.160, 0.140, 0.152), -8), 0.05)  # head
    d = blend(d, ellipsoid(p, (0.395, 0.640, 0), (0.110, 0.085, 0.112), -6), 0.07)  # snout
    for limb in (front_leg, hind_leg, horn, ear, eye, nostril, wing):
        for side in (1, -1):
            d = blend(d, *limb(p * [1, 1, side]))
    for base, tip, size in plates():
        d = blend(d, cone(p * [1, 1, 1.6], base, tip, 0.70 * size, 0.24 * size) / 1.3, 0.02)
    for angle in (64, -8):  # the tail ends in a heart
        along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0])
        d = blend(d, ellipsoid(p, (*SPINE[0, :2], 0) + 0.048 * along, (0.078, 0.054, 0.036), angle), 0.012)
    for side in (1, -1):
        d = carve(d, chain(p * [1, 1, side], SMILE, np.linspace(0.011, 0.008, len(SMILE)), 0.004), 0.012)
    return np.maximum(d, -p[:, 1])  # flat soles


# Limbs on the side z > 0: distance, and the width over which they blend into the body.


def front_leg(p):
    d = chain(p, [(0.100, 0.260, 0.090), (0.130, 0.150, 0.120), (0.135, 0.060, 0.125)], [0.085, 0.070, 0.066], 0.03)
    d = blend(d, ellipsoid(p, (0.165, 0.040, 0.128), (0.090, 0.056, 0.074)), 0.04)
    return with_toes(d, p, 0.245, 0.128), 0.05


def hind_leg(p):
    d = ellipsoid(p, (-0.185, 0.185, 0.108), (0.120, 0.125, 0.085), 20)
    d = blend(d, cone(p, (-0.185, 0.130, 0.135), (-0.200, 0.060, 0.142), 0.078, 0.066), 0.04)
    d = blend(d, ellipsoid(p, (-0.155, 0.040, 0.146), (0.100, 0.056, 0.076)), 0.04)
    return with_toes(d, p, -0.068, 0.146), 0.05


def with_toes(d, p, x, z):
    for dx, dz in ((-0.018, -0.046), (0, 0), (-0.018, 0.046)):
        d = blend(d, ellipsoid(p, (x + dx, 0.028, z + dz), (0.030, 0.029, 0.025)), 0.014)
    return d


def horn(p):
    joints = [(0.225, 0.790, 0.070), (0.165, 0.865, 0.092), (0.130, 0.915, 0.095)]
    return chain(p, joints, [0.046, 0.034, 0.020], 0.02), 0.025


def ear(p):
    joints = [(0.200, 0.700, 0.125), (0.140, 0.720, 0.200), (0.070, 0.690, 0.255)]
    return chain(p, joints, [0.038, 0.052, 0.020], 0.02), 0.03


def eye(p):
    return ellipsoid(p, (0.347, 0.742, 0.096), (0.052, 0.058, 0.050)), 0.008


def nostril(p):
    return ellipsoid(p, (0.470, 0.680, 0.042), (0.024, 0.017, 0.022)), 0.03


def wing(p):
    """A fan of three fingers, webbed, in the plane of u and v."""
    u, v = unit(-0.85, 0.40, 0.35), np.array([-0.15, 0.80, 0.60])
    v = unit(*(v - u * (u @ v)))
    q = (p - (0.010, 0.375, 0.110)) @ np.stack([u, v, np.cross(u, v)], 1) * [1, 1, 1.4]
    d = ellipsoid(q, (0.080, 0.065, 0), (0.140, 0.115, 0.045), 37)
    for angle, length in ((-4, 0.215), (37, 0.260), (78, 0.225)):
        way = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0])
        d = blend(d, cone(q, 0.08 * way, length * way, 0.052, 0.032), 0.06)
    return d / 1.2, 0.03


def plates() -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """The plates along the back, evenly spaced: base, tip, size."""
    arc = np.insert(np.cumsum(np.linalg.norm(np.diff(SPINE[:, :2], axis=0), axis=1)), 0, 0)

    def at(s: float) -> np.ndarray:
        return np.array([np.interp(s, arc, SPINE[:, 0]), np.interp(s, arc, SPINE[:, 1]), 0])

    for s, size in zip(np.linspace(0.27, 0.88, 7) * arc[-1], (0.040, 0.050, 0.060, 0.068, 0.068, 0.066, 0.056)):
        tangent = unit(*(at(s + 0.03) - at(s - 0.03)))
        out = np.array([-tangent[1], tangent[0], 0])
        back = at(s) + np.interp(s, arc, SPINE[:, 2]) * out
        yield back - 0.3 * size * out, back + 0.75 * size * out - 0.30 * size * tangent, size


def polygonise() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles of the half z >= 0, open along z = 0."""
    low, high = np.array([-0.66, -0.02, 0.0]), np.array([0.56, 0.97, 0.36])
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / SPACING) + 1)
    z, y, x = np.meshgrid(*(low[i] + SPACING * np.arange(n) for i, n in ((2, nz), (1, ny), (0, nx))), indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    value = np.concatenate([dragon(part) for part in np.array_split(grid, 40)])
    return igl.marching_cubes(value, grid, nx, ny, nz)[:2]


def seam(F: np.ndarray) -> np.ndarray:
    """Vertices on open edges, which lie in the plane of symmetry."""
    edges, count = np.unique(np.sort(F[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0, return_counts=True)
    return np.unique(edges[count == 1])


def relax(V: np.ndarray, F: np.ndarray, rounds: int) -> np.ndarray:
    """Even out the triangles: move vertices towards the mean of their neighbours, then back onto the surface."""
    on_seam = np.zeros(len(V), bool)
    on_seam[seam(F)] = True
    edges = np.unique(np.sort(F[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0)
    ends = np.concatenate([edges, edges[:, ::-1]])
    ends = ends[~on_seam[ends[:, 0]] | on_seam[ends[:, 1]]]  # the seam relaxes along itself
    degree = np.bincount(ends[:, 0], minlength=len(V))[:, None]
    for _ in range(rounds):
        total = np.stack([np.bincount(ends[:, 0], V[ends[:, 1], i], len(V)) for i in range(3)], 1)
        V = onto_surface(onto_surface(V + 0.4 * (total / degree - V)))
        V[on_seam, 2] = 0
    return V


def onto_surface(V: np.ndarray, eps: float = 1e-4) -> np.ndarray:
    """One damped Newton step along the gradient of the distance."""
    gradient = np.stack([(dragon(V + step) - dragon(V - step)) / (2 * eps) for step in eps * np.eye(3)], 1)
    step = dragon(V) / np.maximum((gradient**2).sum(1), 0.25)
    return V - 0.8 * np.clip(step, -SPACING, SPACING)[:, None] * gradient


def mirrored(V: np.ndarray, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both halves as one closed surface."""
    own = np.ones(len(V), bool)
    own[seam(F)] = False
    other = np.where(own, len(V) + np.cumsum(own) - 1, np.arange(len(V)))
    return np.concatenate([V, V[own] * [1, 1, -1]]), np.concatenate([F, other[F][:, ::-1]])


def picture(V: np.ndarray, F: np.ndarray, path: str) -> None:
    """Four views of the surface."""
    import pyvista as pv

    mesh = pv.PolyData.from_regular_faces(V, F)
    plot = pv.Plotter(off_screen=True, shape=(2, 2), window_size=(1800, 1400))
    for i, eye_at in enumerate(((0.0, 0.15, 3.0), (1.6, 0.7, 2.2), (2.6, 0.5, 0.6), (-2.0, 1.0, 1.8))):
        plot.subplot(i // 2, i % 2)
        plot.add_mesh(mesh, color="#7fb069", smooth_shading=True, specular=0.3, show_edges=i == 3, edge_color="#4a6b3a")
        plot.set_background("white")
        plot.camera_position = [np.add(eye_at, (0, 0.4, 0)), (0, 0.42, 0), (0, 1, 0)]
        plot.camera.zoom(1.6)
    plot.screenshot(path)


def main() -> None:
    V, F = polygonise()
    V = relax(V, F, 3)
    V, F = igl.qslim(np.asfortranarray(V), np.asfortranarray(F.astype(np.int32)), N_TRIANGLES // 2)[:2]
    V[seam(F), 2] = 0
    V, F = mirrored(relax(V, F, 2), F)
    low, high = V.min(0), V.max(0)
    V = (V - [(low[0] + high[0]) / 2, low[1], 0]) * LENGTH / (high[0] - low[0])
    euler = len(V) - len(F) // 2
    print(f"{len(V)} vertices, {len(F)} triangles, Euler characteristic {euler}, size {np.ptp(V, axis=0)} m")
    OUT.parent.mkdir(exist_ok=True)
    np.savez_compressed(OUT, X=V.astype(np.float32), cells=F.astype(np.uint16))
    if len(sys.argv) > 1:
        picture(V, F, sys.argv[1])


if __name__ == "__main__":
    main()
