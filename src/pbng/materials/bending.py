"""Bending of cloth at its hinges, Eq. (35)."""

import math
from dataclasses import dataclass
from typing import ClassVar

from pbng.errors import InputError
from pbng.jit import function
from pbng.materials.base import Block, ConstraintForm

RESTS = ("flat", "mesh")


@dataclass(frozen=True)
class Bending:
    """w k/2 (θ - θ₀)² for each inner edge of a surface, Eq. (35), θ the signed angle between its triangles.

    θ - θ₀ lies in [-π, π]: what folds further than that comes back from the other side.

    Args:
        k: Stiffness [N m], or [J/rad²].
        rest: "flat" for θ₀ = 0, or "mesh" for the angles that the mesh has at rest.
        weighted: Whether w = 3 |e|²/A, with the edge e and the area A of its two triangles at rest, so that stiffness
            does not depend on the mesh; or w = 1 as in the paper.

    Raises:
        InputError: k is negative or not finite, or rest is neither.
    """

    k: float
    rest: str = "flat"
    weighted: bool = False

    isotropic: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.k) and self.k >= 0):
            raise InputError(f"Bending: k must be finite and not negative, not {self.k}")
        if self.rest not in RESTS:
            raise InputError(f"Bending: rest must be 'flat' or 'mesh', not {self.rest!r}")

    @staticmethod
    @function
    def energy(angle, k):
        """Energy [J] of an angle θ - θ₀ [rad]."""
        return type(k)(0.5) * k * angle * angle

    @staticmethod
    @function
    def stress(angle, k):
        """Its derivative, the moment [N m]."""
        return k * angle

    def parameters(self) -> tuple[float, ...]:
        """What ``energy`` and ``stress`` get after the angle."""
        return (self.k,)

    def block(self) -> Block:
        """a = b = k, the curvature of the energy as a function of the angle."""
        return Block(self.k, self.k)

    def paper_block(self) -> Block:
        """The same; what the paper leaves out (37) is a matter of the element."""
        return self.block()

    def constraints(self) -> ConstraintForm | None:
        """None: XPBD and PBD are for solids here."""
        return None
