"""Fixed corotated elasticity, Eq. (7) (Stomakhin et al. 2012)."""

from pbng.linalg import cofactor, det, mat_combine, mat_sub, norm2, rotation
from pbng.materials.base import Block, Material, material


@material
class Corotated(Material):
    """Ψ = μ |F - R|² + λ/2 (J - 1)² with R the rotation of F; robust, and stiff in rotation-free stretch."""

    def energy(F, mu, lam):
        real = type(mu)
        dJ = det(F) - real(1)
        return mu * norm2(mat_sub(F, rotation(F))) + real(0.5) * lam * dJ * dJ

    def stress(F, mu, lam):
        real = type(mu)
        return mat_combine(real(2) * mu, mat_sub(F, rotation(F)), lam * (det(F) - real(1)), cofactor(F))

    def block(self) -> Block:
        """a = 2μ, b = λ: |F - R(F)|² <= |F - R₀|², and J is affine in one node's position."""
        return self.paper_block()
