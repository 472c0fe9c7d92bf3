"""Fixed corotated elasticity, Eq. (7) (Stomakhin et al. 2012)."""

import logging

from pbng.linalg import cofactor, det, mat_combine, mat_sub, norm2, polar, rotation
from pbng.materials.base import Block, Material, material

log = logging.getLogger("pbng")


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

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nu < 0:
            log.warning(
                "Corotated with nu = %g < 0: λ < 0, and the energy has no lower bound at large stretch", self.nu
            )

    def block(self) -> Block:
        """a = 2μ, b = λ: |F - R(F)|² <= |F - R₀|², and J is affine in one node's position."""
        return self.paper_block()
