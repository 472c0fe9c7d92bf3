"""Figs. 13, 14 and 16 and their rows of Table 3, section 11.2: blocks that collide, shapes and bodies that fall."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pbng.drivers import Frame
from pbng.dynamics import BackwardEuler
from pbng.gallery import find
from pbng.gallery.contact import DRIVE, HELD, IN
from pbng.jit import compile_seconds
from pbng.problem import Problem
from pbng.reproduce.common import file_of, need_pictures
from pbng.reproduce.section import Picture, Row, Section, Settings
from pbng.reproduce.twisting import HOPELESS, SELDOM, length, listed, ms, sentence, threads_of
from pbng.solvers.base import Budget
from pbng.solvers.pbng import PBNG, PackedMethod

FPS = 30.0
SHOWN = 6  # frames in a picture
PAPER_K = 1e8  # N/m
SHALLOW = 0.1  # of an edge: penetration that does not show
QUIET = IN + HELD  # s: the end of the time for which the far faces are held, when the blocks ought to be at rest


@dataclass(frozen=True)
class Paper:
    """What the paper says of a scene: counts as printed, time [s], iterations and steps of a frame."""

    label: str
    vertices: str
    elements: str
    triangles: str
    seconds: float
    iterations: int
    steps: int


PAPER = {
    "fig13": Paper("two moving blocks colliding", "8.2 K", "33 K", "0", 1.63, 136, 17),
    "fig14": Paper("dropping simple shapes into box", "256 K", "1069 K", "0", 49.8, 136, 17),
    "fig16": Paper("armadillos dropping", "344 K", "1320 K", "8 K", 101.2, 360, 9),
}


@dataclass(frozen=True, eq=False)
class Fall:
    """A scene of the gallery, run.

    Attributes:
        problem: What was run, as it was at first.
        frames: Those that are shown.
        total: Frames that the scene has, the first included.
        steps: Substeps a frame.
        colors: Node colours at rest, and the most with contacts.
        edge: Mean length of the edges of the surfaces [m].
        seconds, iterations: Of each frame [s].
        finding, packing: Time [s] of each frame in finding contacts, and in colouring and packing.
        pairs, walls: Contacts between surfaces, and vertices at walls, in each frame.
        deepest: Penetration [m] in each frame.
        kinetic, potential: Energy [J] in each frame.
        inverted: Elements in each frame.
    """

    problem: Problem
    frames: tuple[Frame, ...]
    total: int
    steps: int
    colors: tuple[int, int]
    edge: float
    seconds: np.ndarray
    iterations: np.ndarray
    finding: np.ndarray
    packing: np.ndarray
    pairs: np.ndarray
    walls: np.ndarray
    deepest: np.ndarray
    kinetic: np.ndarray
    potential: np.ndarray
    inverted: np.ndarray

    @property
    def n_tet(self) -> int:
        return sum(len(g.cells) for g in self.problem.groups if g.kind.name == "tet")

    @property
    def n_triangle(self) -> int:
        return sum(len(b.mesh.cells) for b in self.problem.bodies if b.mesh.cells.shape[1] == 3)

    @property
    def lost(self) -> bool:
        """Whether it ended before its time, in a state that is none."""
        r = self.frames[-1].result
        return not r.status.ok or r.inverted > HOPELESS * self.problem.n_elem

    @property
    def mean(self) -> float:
        """Time of a frame [s]."""
        return float(self.seconds.mean())

    @property
    def share(self) -> float:
        """Part of the time that goes into finding contacts, colouring and packing."""
        return float((self.finding + self.packing).sum() / self.seconds.sum())

    @property
    def end(self) -> float:
        """Time of the last frame [s]."""
        return len(self.seconds) / FPS

    @property
    def sound(self) -> bool:
        """Whether no frame shows a fault: none is lost, no tet is inverted, and penetration does not show."""
        return not self.lost and int(self.inverted.max()) == 0 and float(self.deepest.max()) < SHALLOW * self.edge

    def at(self, t: float) -> int:
        """Place in the arrays of the frame at time t [s], which is not before the first or after the last."""
        return round(t * FPS) - 1


# What is run at each size: options of the scene, and frames (None for all that it has).
SIZES: Mapping[str, tuple[str, tuple[tuple[dict[str, Any], int | None], ...]]] = {
    "fig13": (
        "two_blocks_colliding",
        (({"resolution": 6}, 76), ({"resolution": 16}, None), ({"resolution": 16}, None)),
    ),
    "fig14": (
        "dropping_shapes",
        (
            ({"resolution": 8, "shapes": 12}, 31),
            ({"resolution": 12, "shapes": 40}, 61),
            ({"resolution": 19, "shapes": 40}, 31),
        ),
    ),
    "fig16": (
        "armadillos",
        (
            ({"resolution": 13, "bodies": 3, "cloth": 24, "free_at": 0.8}, 46),
            ({"resolution": 24, "bodies": 5, "cloth": 64}, None),
            ({"resolution": 44, "bodies": 20, "cloth": 64}, 21),
        ),
    ),
}


def fall(name: str, settings: Settings, **more: Any) -> Fall:
    """The scene of a figure at the size of the settings, run; it is run once for all that ask."""
    scene, sizes = SIZES[name]
    options, frames = settings.by_size(*sizes)
    return _fall(scene, tuple(sorted((options | more).items())), frames, settings.threads)


@lru_cache(maxsize=4)
def _fall(scene: str, options: tuple[tuple[str, Any], ...], most: int | None, threads: int | None) -> Fall:
    recipe = find(scene)(**dict(options))
    total, steps = recipe.frames or 1, recipe.substeps or 1
    frames = total if most is None else min(most, total)
    problem = recipe.scene.compile(free=True)
    budget = Budget(iterations=recipe.budget.iterations, every=SELDOM)
    solver, still = PBNG(threads=threads), np.zeros_like(problem.X)
    moving = BackwardEuler(problem, solver, 1 / (FPS * steps), problem.X, still)
    wanted = set(np.linspace(0, frames - 1, SHOWN).round().astype(int).tolist())
    kept, told, colors = [Frame(0, 0.0, moving.x, moving.look(), problem, moving.v, moving.report())], [], []
    for k in range(1, frames):
        compiling = compile_seconds()
        result = moving.advance(steps, budget)
        frame = Frame(k, moving.t, result.x, result, moving.problem, moving.v, moving.report())
        told.append(_numbers(frame, compile_seconds() - compiling))
        assert isinstance(moving.method, PackedMethod)
        colors += [1 + int(nodes.color.max()) for nodes in moving.method.contact_nodes.values()]
        if k in wanted:
            kept.append(frame)
        if not result.status.ok or result.inverted > HOPELESS * problem.n_elem:
            kept += [] if k in wanted else [frame]
            break  # there is no way back
    assert problem.contact is not None
    assert problem.contact.surfaces is not None
    plain = 1 + int(problem.color.max())
    spacing = float(problem.contact.surfaces.spacing.mean())
    return Fall(
        problem, tuple(kept), total, steps, (plain, max([plain, *colors])), spacing, *np.array(told).T
    )  # fmt: skip


def _numbers(frame: Frame, compiling: float) -> tuple[float, ...]:
    r, c = frame.result, frame.contact
    assert c is not None
    return (
        c.seconds - r.monitor_seconds - compiling, r.iterations, c.detect_seconds, c.pack_seconds, c.pairs, c.walls,
        c.deepest, frame.kinetic_energy, frame.potential_energy, r.inverted,
    )  # fmt: skip


def fig13(settings: Settings) -> Section:
    """Two blocks are driven together: contacts come, and go."""
    need_pictures()
    ours, stiff = fall("fig13", settings), fall("fig13", settings, k_n=PAPER_K)
    rows = [*_rows("fig13", ours), *_stiff_rows(ours, stiff)]
    path = _strip(settings, ours.frames, color="contact", azimuth=18.0, elevation=12.0)
    face = _strip(settings, [_left(f) for f in ours.frames], "face.png", color="contact", azimuth=62.0, elevation=12.0)
    return Section(
        name="fig13",
        title="Two blocks colliding",
        scene=f"Two cubes of 1 m, {ours.problem.n_vert:,} vertices and {ours.n_tet:,} tets, E = 1000 Pa, density"
        f" 10 kg/m³; their far faces are driven {2 * DRIVE:g} m towards each other within {IN:g} s, held, and drawn"
        f" apart. {_method(ours, settings)}",
        claim="Where vertices collide, dynamic weak constraints are built, which resolve the collision.",
        found=_collided(ours, stiff),
        rows=tuple(rows),
        pictures=(
            Picture(path, "The blocks; red are vertices in contact."),
            Picture(face, "The left block alone, from where the other one is: red are the vertices that it touches."),
        ),
        record=_record(ours) | {"paper_k": _record(stiff)},
    )


def _left(frame: Frame) -> Frame:
    """The frame with its first body alone."""
    problem, contact = frame.problem, frame.contact
    assert contact is not None
    own = contact.vertices[contact.vertices < problem.bodies[0].stop]
    return replace(
        frame, problem=replace(problem, bodies=problem.bodies[:1]), contact=replace(contact, vertices=own)
    )  # fmt: skip


def fig14(settings: Settings) -> Section:
    """Simple shapes fall into a glass box."""
    need_pictures()
    ours = fall("fig14", settings)
    n = len(ours.problem.bodies)
    return Section(
        name="fig14",
        title="Objects dropping",
        scene=f"{n} boxes, balls, rings, planks and rods, {ours.problem.n_vert:,} vertices and {ours.n_tet:,} tets in"
        f" all, E = 3000 Pa, density 10 kg/m³, fall into a glass box. {_method(ours, settings)}",
        claim="PBNG handles collision-intensive scenes robustly.",
        found=_robust(ours, settings, "fig14"),
        rows=tuple(_rows("fig14", ours)),
        pictures=(Picture(_strip(settings, ours.frames), "The shapes and the box."),),
        record=_record(ours),
    )


def fig16(settings: Settings) -> Section:
    """Bodies fall onto a cloth that gives way."""
    need_pictures()
    ours = fall("fig16", settings)
    n = len(ours.problem.bodies) - 1
    free_at = dict(settings.by_size(*SIZES["fig16"][1])[0]).get("free_at", 10 / 3)
    freed = f"after {free_at:.3g} s two of them are let go"
    freed += ", which is not reached here" if ours.end < free_at else ""
    return Section(
        name="fig16",
        title="Armadillos dropping",
        scene=f"{n} little dragons in place of the paper's 20 armadillos, E = 1000 Pa, density 10 kg/m³, and a cloth of"
        f" 3 m by 3 m, E = 10,000 N/m, density 10 kg/m², k_b = 0.05 N m, held by four corners; {freed}."
        f" {ours.problem.n_vert:,} vertices, {ours.n_tet:,} tets and {ours.n_triangle:,} triangles in all."
        f" {_method(ours, settings)}",
        claim="PBNG handles a large scene with many collisions, in which cloth and solids are coupled.",
        found=_robust(ours, settings, "fig16"),
        rows=tuple(_rows("fig16", ours)),
        pictures=(Picture(_strip(settings, ours.frames, elevation=10.0), "The bodies, the cloth and the box below."),),
        record=_record(ours),
    )


def table_rows(settings: Settings) -> tuple[list[Row], list[dict[str, Any]]]:
    """The rows of Table 3 with contact, and their record."""
    rows, record = [], []
    for name, theirs in PAPER.items():
        ours = fall(name, settings)
        faster = f"; {theirs.seconds / ours.mean:.2g} times as fast" if ours.mean < theirs.seconds else ""
        rows.append(
            Row(
                f"{theirs.label}, Corotated",
                ms(theirs.seconds),
                ms(ours.mean),
                f"{ours.problem.n_vert:,} vertices ({theirs.vertices}), {ours.n_tet:,} tets ({theirs.elements}),"
                f" {_each(ours)} iterations in {ours.steps} substeps ({theirs.iterations} in {theirs.steps});"
                f" {100 * ours.share:.0f} % of it contact{faster}{_partly(ours)}",
            )
        )
        record.append({"what": theirs.label, "vertices": ours.problem.n_vert, "seconds": ours.mean})
    return rows, record


def _method(ours: Fall, settings: Settings) -> str:
    return (
        f"Backward Euler, {len(ours.seconds)} of {ours.total - 1} frames of 1/30 s, {ours.steps} substeps each with"
        f" {_each(ours) // ours.steps} iterations of PBNG with Anderson mixing; contacts are found at each substep. On"
        f" {threads_of(settings)}."
    )


def _each(ours: Fall) -> int:
    return round(float(np.median(ours.iterations)))


def _partly(ours: Fall) -> str:
    return f"; the first {len(ours.seconds)} of {ours.total - 1} frames" if len(ours.seconds) < ours.total - 1 else ""


def _rows(name: str, ours: Fall) -> list[Row]:
    p, i = PAPER[name], int(ours.seconds.argmax())
    parts = [(ours.finding.sum(), "finding contacts"), (ours.packing.sum(), "colouring and packing")]
    told = listed([f"{100 * s / ours.seconds.sum():.0f} % {what}" for s, what in parts])
    rows = [Row("vertices", p.vertices, f"{ours.problem.n_vert:,}"), Row("tets", p.elements, f"{ours.n_tet:,}")]
    if ours.n_triangle:
        rows.append(Row("triangles of cloth", p.triangles, f"{ours.n_triangle:,}"))
    begun = ours.pairs + ours.walls > 0
    contact = f"{ms(float(ours.seconds[begun].mean()))} on average once something touches" if begun.any() else ""
    return [
        *rows,
        Row("iterations a frame", f"{p.iterations}", f"{_each(ours)}"),
        Row("substeps a frame", f"{p.steps}", f"{ours.steps}"),
        Row("node colours", "11" if name == "fig14" else "", f"{ours.colors[0]}", f"{ours.colors[1]} with contacts"),
        Row("time of a frame", f"{ms(p.seconds)}, 8 threads", ms(ours.mean), f"{contact}{_partly(ours)}"),
        Row("longest frame", "", ms(float(ours.seconds[i])), f"at {(i + 1) / FPS:.2f} s"),
        Row("share of contact", "", f"{100 * ours.share:.0f} %", told),
        Row("contacts at most", "", f"{int(ours.pairs.max()):,}", f"and {int(ours.walls.max()):,} vertices at walls"),
        Row("deepest penetration", "", length(float(ours.deepest.max())), f"edges are {length(ours.edge)} long"),
        Row("inverted tets", "", f"{int(ours.inverted[-1]):,}", f"at most {int(ours.inverted.max()):,} on the way"),
    ]  # fmt: skip


def _stiff_rows(ours: Fall, stiff: Fall) -> list[Row]:
    words = "with k_n = 1e8 N/m: "
    t, theirs, own = _quiet(ours, stiff)
    if stiff.lost:
        remark = f"the kinetic energy is {theirs:.2g} J at {t:.2f} s, {own:.2g} J with ours"
        return [Row(f"{words}lost at", "", f"{stiff.end:.2f} s", remark)]
    return [
        Row(
            f"{words}inverted tets at most",
            "",
            f"{int(stiff.inverted.max()):,}",
            f"{int(ours.inverted.max()):,} with ours",
        ),
        Row(
            f"{words}deepest penetration",
            "",
            length(float(stiff.deepest.max())),
            f"{length(float(ours.deepest.max()))} with ours",
        ),
        Row(f"{words}energy of motion", "", f"{theirs:.2g} J", f"{own:.2g} J with ours, at {t:.2f} s"),
    ]


def _quiet(ours: Fall, stiff: Fall) -> tuple[float, float, float]:
    """When the blocks ought to be at rest [s], or the last moment of both runs, and the kinetic energy then [J] with
    the paper's contacts and with ours."""
    t = min(QUIET, ours.end, stiff.end)
    return t, float(stiff.kinetic[stiff.at(t)]), float(ours.kinetic[ours.at(t)])


def _collided(ours: Fall, stiff: Fall) -> str:
    touching = np.flatnonzero(ours.pairs > 0)
    if len(touching) == 0:
        return "The blocks never touch."
    words = f"The blocks touch from {(touching[0] + 1) / FPS:.2f} s to {(touching[-1] + 1) / FPS:.2f} s, with up to"
    words += f" {int(ours.pairs.max()):,} contacts; {_shallow(ours)}"
    words += " Apart again, no contact is left." if ours.pairs[-1] == 0 else " They still touch at the end."
    words += _upright(ours)
    words += f" A frame takes {ms(ours.mean)}, where the paper has {ms(PAPER['fig13'].seconds)} on 8 threads"
    words += "." if ours.problem.n_vert > 8000 else " for a larger mesh."
    words += " With the paper's k_n of 1e8 N/m"
    t, theirs, own = _quiet(ours, stiff)
    if stiff.lost:
        words += f" the blocks are lost after {stiff.end:.2f} s: {_cause()}"
    elif t == QUIET and theirs > 3 * own:
        words += f" what ought to be at rest moves, with {theirs:.2g} J where ours has {own:.2g} J: {_cause()}"
    else:
        words += f" the blocks are as quiet, and penetration is {length(float(stiff.deepest.max()))}"
    return words + "; ours is tied to the stiffness of the blocks."


def _cause() -> str:
    return "contacts found a little too late hold much energy then, which throws vertices back"


def _robust(ours: Fall, settings: Settings, name: str) -> str:
    words = "All frames are sound" if ours.sound else "It runs on without being lost, but not every frame is sound"
    words = f"The state is lost after {ours.end:.2f} s" if ours.lost else words
    words += f": up to {int(ours.pairs.max()):,} contacts between bodies, {int(ours.walls.max()):,} vertices at walls;"
    words += f" {_shallow(ours)}{_upright(ours)}"
    theirs = PAPER[name]
    words += f" A frame takes {ms(ours.mean)} on average, {100 * ours.share:.0f} % of it for contact; the paper's takes"
    words += f" {ms(theirs.seconds)} on 8 threads"
    words += "." if settings.size == "paper" else f", with {theirs.vertices} vertices, which is no comparison."
    return words + (f" Only the first {len(ours.seconds)} of {ours.total - 1} frames are run." if _partly(ours) else "")


def _shallow(ours: Fall) -> str:
    deepest = float(ours.deepest.max())
    words = f"the deepest penetration is {length(deepest)}, {deepest / ours.edge:.2g} of an edge"
    return words + (", which does not show." if deepest < SHALLOW * ours.edge else ", which shows.")


def _upright(ours: Fall) -> str:
    most, last = int(ours.inverted.max()), int(ours.inverted[-1])
    if most == 0:
        return " No tet is ever inverted."
    return f" {sentence(f'{most:,}')} tets at most are inverted in a frame, {last:,} in the last."


def _strip(
    settings: Settings,
    frames: Sequence[Frame],
    name: str = "frames.png",
    *,
    color: str = "body",
    azimuth: float = 24.0,
    elevation: float = 16.0,
) -> Path:
    from pbng.view import sheet

    path = file_of(settings, name)
    return sheet(list(frames), path, SHOWN, color=color, azimuth=azimuth, elevation=elevation)


def _record(ours: Fall) -> dict[str, Any]:
    arrays = ("seconds", "finding", "packing", "deepest", "kinetic", "potential")
    counts = ("iterations", "pairs", "walls", "inverted")
    return {
        "vertices": ours.problem.n_vert,
        "tets": ours.n_tet,
        "triangles": ours.n_triangle,
        "substeps": ours.steps,
        "colors": list(ours.colors),
        "edge": ours.edge,
        **{k: getattr(ours, k).tolist() for k in arrays},
        **{k: getattr(ours, k).astype(int).tolist() for k in counts},
    }
