"""Scenes: bodies, what holds and moves them, what loads them; ``compile`` makes the frozen problem."""

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np

from pbng.bindings import Binding, bind, weak_constraints
from pbng.bodies import Body, Points, Selection
from pbng.checks import checked_number, checked_vector
from pbng.contact.collider import Collider
from pbng.contact.surfaces import ContactRule, contact_spec, has_surface
from pbng.elements.base import ElementKind
from pbng.elements.hinge import HINGES
from pbng.elements.membrane import MEMBRANE
from pbng.elements.simplex import PLANE_TRIANGLE, TET
from pbng.errors import InputError
from pbng.materials.base import Material
from pbng.materials.bending import Bending
from pbng.mesh import Mesh, TetMesh, TriMesh, triangle_areas
from pbng.motions import Motion, as_motion
from pbng.prescribed import Move, Prescribed, check_clash, phases
from pbng.problem import BodyRange, ElementGroup, Problem

log = logging.getLogger("pbng")


class Scene:
    """What is simulated. Scenes never see solvers.

    Args:
        gravity: Acceleration [m/s²]; default none.
        name: Shown in reports.
    """

    def __init__(self, gravity: Sequence[float] = (0.0, 0.0, 0.0), name: str = "scene") -> None:
        self.name = name
        self.gravity = checked_vector("gravity", gravity)
        self.bodies: list[Body] = []
        self._moves: list[Move] = []
        self._waits: list[Move] = []  # of bodies, as pins of the whole
        self._forces: list[tuple[np.ndarray, np.ndarray]] = []
        self._bindings: list[Binding] = []
        self._contact: ContactRule | None = None
        self.colliders: list[Collider] = []

    def add(
        self,
        mesh: Mesh,
        material: Material | Mapping[str, Material],
        bending: Bending | None = None,
        name: str | None = None,
        at: Any = None,
        wait: float = 0.0,
    ) -> Body:
        """Add a body.

        Args:
            mesh: Its rest state.
            material: One material, or one for each of the mesh's cell groups, which must cover every cell once. With
                :class:`pbng.Membrane` triangles are cloth, with a material of solids they are plane strain.
            bending: How cloth resists bending; by default not at all.
            name: Unique; by default numbered.
            at: Translation [m] of the mesh, (3,).
            wait: Time [s] until which all of it is held where it is: at rest, or where moves have left it.

        Raises:
            InputError: The name is taken, groups are unknown, overlap or leave cells out, triangles of a solid are not
                plane, cloth has an edge of more than two triangles or neighbours that are not oriented alike, or
                ``wait`` is negative.
        """
        name = f"body{len(self.bodies)}" if name is None else name
        if name in (b.name for b in self.bodies):
            raise InputError(f"the scene already has a body named {name!r}")
        if not isinstance(mesh, Mesh):
            raise InputError(f"body {name!r}: expected a TetMesh or TriMesh, not {type(mesh).__name__}")
        if at is not None:
            mesh = mesh.moved(mesh.X + checked_vector(f"body {name!r}: at", at))
        start = sum(b.mesh.n_vert for b in self.bodies)
        wait = checked_number(f"body {name!r}: wait", wait, positive=False)
        body = Body(name, mesh, _materials(name, mesh, material), start, bending)
        self.bodies.append(body)
        if wait > 0:
            self._waits.append(Move(f"wait of body {name!r}", start + np.arange(mesh.n_vert), None, until=wait))
        return body

    def pin(self, selection: Selection, until: float = math.inf) -> None:
        """Hold vertices where they are at rest, or where moves take them.

        Args:
            selection: The vertices.
            until: Time [s] at which they are let go, unless something else still holds them.

        Raises:
            InputError: As for :meth:`move`.
        """
        self._prescribe("pin", selection, None, until=until)

    def move(
        self, selection: Selection, motion: Any, over: float = 0.0, start: float = 0.0, until: float = math.inf
    ) -> None:
        """Prescribe the motion of vertices.

        Moves of the same vertices follow upon each other, in order of their start: each starts from where the ones
        before have left them.

        Args:
            selection: The vertices.
            motion: A :class:`pbng.Motion`, or a function ``(t, X) -> x``. Rotations and scalings act about the
                selection's centroid unless they name a center.
            over: Seconds [s] in which it is carried out at a steady rate; 0 at once.
            start: Time [s] at which it begins; until then the vertices are held.
            until: Time [s] at which the motion stops and the vertices are let go, unless something else still holds
                them; by default they stay where the motion has ended.

        Raises:
            InputError: The selection is empty, ``until`` is not later than the start, or it has only some vertices in
                common with another pin or move, and neither lets go before the other starts.
        """
        self._prescribe("move", selection, as_motion(motion), over=over, start=start, until=until)

    def _prescribe(self, what: str, selection: Selection, motion: Motion | None, **times: float) -> None:
        index = self._checked(what, selection)
        move = Move(f"{what} of {_words(selection)}", index, motion, **times)
        check_clash(move, self._moves)
        self._moves.append(move)

    def force(self, selection: Selection, force: Sequence[float]) -> None:
        """Spread a total force [N] evenly over vertices."""
        index = self._checked("force", selection)
        self._forces.append((index, np.tile(np.array(checked_vector("force", force)) / len(index), (len(index), 1))))

    def traction(self, selection: Selection, traction: Sequence[float]) -> None:
        """Apply a traction [N/m²] to the part of the surface whose triangles' vertices are all selected, Eq. (16).

        Per rest area and of fixed direction. In the plane the boundary's edges take the place of triangles [N/m].
        """
        index = self._checked("traction", selection)
        mesh, start, faces = selection.body.mesh, selection.body.start, selection.faces
        if len(faces) == 0:
            raise InputError(f"traction on {_words(selection)}: no whole face of the surface is selected")
        if faces.shape[1] == 3:
            measure = np.linalg.norm(triangle_areas(mesh.X, faces), axis=1)
        else:
            measure = np.linalg.norm(mesh.X[faces[:, 1]] - mesh.X[faces[:, 0]], axis=1)
        share = np.zeros(mesh.n_vert)
        np.add.at(share, faces, (measure / faces.shape[1])[:, None])
        self._forces.append((index, np.outer(share[index - start], np.array(checked_vector("traction", traction)))))

    def bind(
        self,
        a: Selection | Points,
        b: Any,
        k: Any = None,
        *,
        k_n: Any = None,
        k_tau: Any = 0.0,
        normal: Any = None,
        over: float = 0.0,
        start: float = 0.0,
    ) -> None:
        """Tie points to points by springs without length: weak constraints, Eqs. (18)-(19).

        The stiffness is k, the same in all directions, or k_n along a normal and k_tau across it.

        Args:
            a: The points: selected vertices, or :meth:`Body.points`.
            b: What they are tied to: as many points of a body; a body, or a selection of its vertices, for the closest
                point of its faces at rest (of those that are wholly selected; of the vertices if none is); positions
                [m], (m, 3) or (3,); or a motion as :meth:`move` takes it, of the points a.
            k: Stiffness [N/m] of each spring, a number or (m,).
            k_n, k_tau: Stiffness along and across the normal [N/m], numbers or (m,).
            normal: Directions (m, 3) or (3,), fixed in space; by default the closest face's outward normal at rest.
            over, start: Of a motion [s], as for :meth:`move`.

        Raises:
            InputError: There is nothing to tie, sizes differ, weights do not sum to one, or a stiffness is negative or
                not finite.
        """
        points = self._checked_points("bind", a)
        other: Any = b
        if isinstance(b, Body):
            self._check_body("bind", b)
        elif isinstance(b, Selection | Points):
            self._checked_points("bind", b)
        elif isinstance(b, Motion) or callable(b):
            move = Move("bind", np.arange(len(points)), as_motion(b), start, over)
            other = Prescribed(points.X, [move], np.ones(len(points), bool))
        binding = bind(points, other, k, k_n, k_tau, normal)
        weak_constraints([binding])  # says what is wrong with it here, and not when the scene compiles
        self._bindings.append(binding)

    def collide_with(self, colliders: Collider | Sequence[Collider]) -> None:
        """Keep the surfaces of all bodies, and cloth, out of kinematic bodies (section 7.2).

        Args:
            colliders: :class:`pbng.Plane`, :class:`pbng.Sphere`, :class:`pbng.Capsule`, :class:`pbng.Box`,
                :class:`pbng.Kinematic`, or a list of them.

        Raises:
            InputError: One is not a collider.
        """
        several: list[Any] = list(colliders) if isinstance(colliders, list | tuple) else [colliders]
        for c in several:
            if not isinstance(c, Collider):
                raise InputError(f"collide_with: expected a collider such as Plane or Kinematic, not {c!r:.80}")
        self.colliders += several

    def contact(
        self,
        *bodies: Body,
        k_n: float | None = None,
        k_tau: float = 0.0,
        radius: float | None = None,
        thickness: float | None = None,
        self_collision: bool | Body | Sequence[Body] = False,
        rings: int = 2,
    ) -> None:
        """Let bodies, solids and cloth, collide with each other.

        Contacts are one-sided springs between points and triangles and between edges, found anew at each step.

        Args:
            bodies: Which; by default all that the scene has when it compiles.
            k_n: Stiffness along the normal [N/m]; by default ten times the E h of the softer body.
            k_tau: Stiffness across it [N/m]: 0 slides, more holds on like friction while there is contact.
            radius: Distance [m] below which surfaces count as close; by default half the mean length of their edges, or
                with inertia a tenth, and what they move in a step besides.
            thickness: Distance [m] that is kept; by default none between solids, and for cloth that of its material or
                a fifth of the mean length of its edges.
            self_collision: Whether bodies collide with themselves, or which do.
            rings: Rings of triangles around a vertex with which it does not collide.

        Raises:
            InputError: It was called before, a number is negative or not finite, k_n or the radius is zero, or a body
                belongs to another scene.
        """
        if self._contact is not None:
            raise InputError("contact: called twice; one rule holds for the scene")
        k_n = None if k_n is None else checked_number("contact: k_n", k_n)
        radius = None if radius is None else checked_number("contact: radius", radius)
        k_tau = checked_number("contact: k_tau", k_tau, positive=False)
        if thickness is not None:
            thickness = checked_number("contact: thickness", thickness, positive=False)
        if not (isinstance(rings, Integral) and rings >= 1):
            raise InputError(f"contact: rings must be a whole number of at least 1, not {rings!r}")
        own: Any = (self_collision,) if isinstance(self_collision, Body) else self_collision
        if not isinstance(own, bool | Iterable):
            raise InputError(f"contact: self_collision must be True, False or bodies, not {own!r}")
        own = own if isinstance(own, bool) else tuple(own)
        for b in (*bodies, *(own if isinstance(own, tuple) else ())):
            if not isinstance(b, Body):
                raise InputError(f"contact: expected bodies, not {type(b).__name__}")
            self._check_body("contact", b)
            if not has_surface(b):
                raise InputError(f"contact: body {b.name!r} has no surface: it is plane")
        self._contact = ContactRule(bodies, own, k_n, k_tau, radius, thickness, int(rings))

    def _checked_points(self, what: str, points: Any) -> Points:
        if isinstance(points, Points):
            self._check_body(what, points.body)
            return points
        self._checked(what, points)
        return points.points

    def _checked(self, what: str, selection: Selection) -> np.ndarray:
        if not isinstance(selection, Selection):
            raise InputError(f"{what}: expected a selection such as body.where(x=0), not {type(selection).__name__}")
        self._check_body(what, selection.body)
        if len(selection) == 0:
            low, high = selection.body.mesh.X.min(0), selection.body.mesh.X.max(0)
            spans = ", ".join(f"{a} in [{l:g}, {h:g}]" for a, l, h in zip("xyz", low, high))
            raise InputError(f"{what}: {_words(selection)} selects no vertex; it has {spans}")
        return selection.index

    def _check_body(self, what: str, body: Body) -> None:
        if not any(b is body for b in self.bodies):
            raise InputError(f"{what}: body {body.name!r} belongs to another scene")

    def compile(self, free: bool = False) -> Problem:
        """The discrete problem of this scene as it now stands; ``free`` allows that nothing holds a body.

        Else a warning says which bodies, or parts of them, nothing holds, at first or after something was let go.

        Raises:
            InputError: There is no body, or nothing is held at first.
        """
        if not self.bodies:
            raise InputError("the scene has no body")
        X = np.concatenate([b.mesh.X for b in self.bodies])
        groups: dict[tuple[ElementKind, Material | Bending], list[np.ndarray]] = {}
        mass = np.zeros(len(X))
        for b in self.bodies:
            kind = TET if isinstance(b.mesh, TetMesh) else MEMBRANE if b.is_cloth else PLANE_TRIANGLE
            for material, cells in b.materials:
                global_cells = (b.mesh.cells[cells] + b.start).astype(np.int32)
                groups.setdefault((kind, material), []).append(global_cells)
                weight = material.density * b.mesh.volume[cells] / kind.corners
                mass += np.bincount(global_cells.ravel(), np.repeat(weight, kind.corners), len(X))
            if b.bending is not None and b.bending.k > 0 and isinstance(b.mesh, TriMesh) and len(b.mesh.hinges):
                hinge = HINGES[b.bending.weighted, b.bending.rest == "mesh"]
                groups.setdefault((hinge, b.bending), []).append((b.mesh.hinges + b.start).astype(np.int32))
        f_ext = np.outer(mass, self.gravity)
        for index, force in self._forces:
            np.add.at(f_ext, index, force)
        for b in self.bodies:
            if isinstance(b.mesh, TriMesh) and not b.is_cloth:
                f_ext[b.start : b.start + b.mesh.n_vert, 2] = 0  # plane strain: z never moves
        weak = weak_constraints(self._bindings)
        *earlier, (since, fixed, prescribed) = phases(X, [*self._moves, *self._waits])
        problem = Problem(
            name=self.name,
            X=X,
            groups=tuple(ElementGroup(kind, m, np.concatenate(cells)) for (kind, m), cells in groups.items()),
            bodies=tuple(BodyRange(b.name, b.start, b.start + b.mesh.n_vert, b.mesh) for b in self.bodies),
            fixed=fixed,
            prescribed=prescribed,
            f_ext=f_ext,
            mass=mass,
            end=max(
                [
                    0.0,
                    *(m.end for m in (*self._moves, *self._waits)),
                    *(c.end for c in self.colliders),
                    *(b.targets.end for b in self._bindings if isinstance(b.targets, Prescribed)),
                ]
            ),
            weak=weak,
            contact=contact_spec(self.bodies, self._contact, self.colliders),
        )
        for begins, fixed, prescribed in reversed(earlier):
            problem = replace(problem, fixed=fixed, prescribed=prescribed, until=since, after=problem)
            since = begins
        if not free:
            if not problem.held:
                raise InputError("no vertex is pinned or moved: the equilibrium is not unique; pin a part of each body")
            _warn_of_loose_parts(problem)
        return problem


def _warn_of_loose_parts(problem: Problem) -> None:
    """Say what nothing holds, at first and whenever vertices are let go.

    Parts that may touch colliders or other parts are left out, for these may hold them; unless nothing is held at all.
    """
    part, contact = problem.component, problem.contact

    def among(*vertices: np.ndarray) -> np.ndarray:
        """Which parts (n_part,) some of these vertices belong to."""
        found = np.zeros(part.max() + 1, bool)
        for v in vertices:
            found[part[v]] = True
        return found

    anchored = among(*(w.vertices.ravel() for w in problem.weak if w.anchored))
    touching = among(contact.surface) if contact is not None else among()
    if touching.sum() == 1 and contact is not None and not contact.colliders:
        touching[:] = False  # it can touch itself alone
    told = among()
    for since, phase in problem.phases():
        loose = ~(anchored | among(phase.fixed) | told)
        if phase.held:
            loose &= ~touching
        for label in np.flatnonzero(loose):
            log.warning(
                "%snothing holds %s: it can move as a rigid body, and under load it has no equilibrium",
                f"after t = {since:g} s " if since > 0 else "", _named(problem, np.flatnonzero(part == label)),
            )  # fmt: skip
        told |= loose


def _named(problem: Problem, vertices: np.ndarray) -> str:
    """The bodies, or parts of bodies, that these vertices (k,) are."""
    names = []
    for body in problem.bodies:
        mine = vertices[(vertices >= body.start) & (vertices < body.stop)]
        if len(mine) == body.stop - body.start:
            names.append(f"body {body.name!r}")
        elif len(mine):
            names.append(f"a part of body {body.name!r} ({len(mine)} vertices, among them {mine[0] - body.start})")
    return " and ".join(names)


def _words(selection: Selection) -> str:
    """How a selection was made."""
    return f"{selection.body.name}.where({selection.words})"


def _materials(name: str, mesh: Mesh, material: Any) -> tuple[tuple[Material, np.ndarray], ...]:
    if isinstance(material, Material):
        return ((material, np.arange(mesh.n_elem)),)
    if not isinstance(material, Mapping) or not material:
        raise InputError(
            f"body {name!r}: expected a material or a mapping of cell groups to materials, not {material!r}"
        )
    times = np.zeros(mesh.n_elem, int)
    parts = []
    for group, m in material.items():
        if group not in mesh.cell_groups:
            raise InputError(
                f"body {name!r}: no cell group {group!r}; the mesh has {sorted(mesh.cell_groups) or 'none'}"
            )
        if not isinstance(m, Material):
            raise InputError(f"body {name!r}: cell group {group!r} needs a material, not {m!r}")
        times[mesh.cell_groups[group]] += 1
        parts.append((m, mesh.cell_groups[group]))
    wrong = np.flatnonzero(times != 1)
    if len(wrong):
        raise InputError(
            f"body {name!r}: cell {wrong[0]} belongs to {times[wrong[0]]} of the groups {sorted(material)}, not to one"
            f" ({len(wrong)} such cells)"
        )
    return tuple(parts)
