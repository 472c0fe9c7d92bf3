"""Fixed corotated elasticity, Eq. (7) (Stomakhin et al. 2012)."""

import logging
import math

from pbng.jit import function
from pbng.linalg import cofactor, det, mat_combine, mat_scale, mat_sub, norm2, polar, rotation
from pbng.materials.base import Block, ConstraintForm, Material, material
from pbng.materials.differentials import cofactor_differential, mat_dot, rotation_differential

log = logging.getLogger("pbng")


@function
def strain(F, mu, lam):
    """C = |F - R| and ∂C/∂F = (F - R) / C, which goes to zero where C does, as it has no direction there."""
    real = type(mu)
    R, s = polar(F)
    D = mat_sub(F, R)
    square = norm2(F) - real(2) * s + real(3)  # as in the energy
    C = math.sqrt(max(norm2(D) if square < real(0.1) else square, real(0)))
    return C, mat_scale(real(1) / max(C, real(1e-12)), D)


@function
def volume(F, mu, lam):
    """C = J - 1 and ∂C/∂F = H."""
    H = cofactor(F)
    return det(F) - type(mu)(1), H


@material
class Corotated(Material):
    """Ψ = μ |F - R|² + λ/2 (J - 1)² with R the rotation of F; robust, and stiff in rotation-free stretch."""

    def energy(F, mu, lam):
        real = type(mu)
        R, s = polar(F)
        strain2 = norm2(F) - real(2) * s + real(3)  # |F - R|², also where R is not unique and comes out short
        if strain2 < real(0.1):
            strain2 = norm2(mat_sub(F, R))  # near rest, without the cancellation
        dJ = det(F) - real(1)
        return mu * strain2 + real(0.5) * lam * dJ * dJ

    def stress(F, mu, lam):
        real = type(mu)
        return mat_combine(real(2) * mu, mat_sub(F, rotation(F)), lam * (det(F) - real(1)), cofactor(F))

    def hessian(F, D, mu, lam):
        real = type(mu)
        H = cofactor(F)
        stretch = mat_sub(D, rotation_differential(F, rotation(F), D))
        volume = mat_combine(lam * mat_dot(H, D), H, lam * (det(F) - real(1)), cofactor_differential(F, D))
        return mat_combine(real(2) * mu, stretch, real(1), volume)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nu < 0:
            log.warning(
                "Corotated with nu = %g < 0: λ < 0, and the energy has no lower bound at large stretch", self.nu
            )

    def block(self) -> Block:
        """a = 2μ, b = λ: |F - R(F)|² <= |F - R₀|², and J is affine in one node's position."""
        return self.paper_block()

    def constraints(self) -> ConstraintForm:
        """C₁ = |F - R| with k = 2μ and C₂ = J - 1 with k = λ."""
        return ConstraintForm((strain, volume), (2 * self.mu, self.lam))
