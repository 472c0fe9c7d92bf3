"""Stable Neo-Hookean elasticity, Eq. (10) (Smith et al. 2018)."""

import math

from pbng.linalg import cofactor, det, mat_add, mat_combine, norm2
from pbng.materials.base import Block, Material, material
from pbng.materials.differentials import cofactor_differential, mat_dot


@material
class StableNeoHookean(Material):
    """Ψ = μ'/2 (|F|² - 3) + λ'/2 (J - α)² - μ'/2 log(1 + |F|²), α = 1 + 3μ'/(4λ'), less its value at rest.

    The factor λ', lost in the paper's text, and μ' = 4/3 μ, λ' = λ + 5/6 μ, which make it agree with linear elasticity
    at rest, are corrections (docs/errata.md).
    """

    def energy(F, mu_s, lam_s):
        real = type(mu_s)
        dJ = det(F) - real(1)
        growth = norm2(F) - real(3)
        return (
            real(0.5) * mu_s * (growth - math.log(real(1) + real(0.25) * growth))
            + (real(0.5) * lam_s * dJ - real(0.75) * mu_s) * dJ
        )

    def stress(F, mu_s, lam_s):
        real = type(mu_s)
        a = mu_s - mu_s / (real(1) + norm2(F))
        return mat_combine(a, F, lam_s * (det(F) - real(1)) - real(0.75) * mu_s, cofactor(F))

    def hessian(F, D, mu_s, lam_s):
        real = type(mu_s)
        H = cofactor(F)
        share = real(1) / (real(1) + norm2(F))
        pressure = lam_s * (det(F) - real(1)) - real(0.75) * mu_s
        volume = mat_combine(lam_s * mat_dot(H, D), H, pressure, cofactor_differential(F, D))
        growth = real(2) * mu_s * share * share * mat_dot(F, D)
        return mat_add(mat_combine(mu_s - mu_s * share, D, growth, F), volume)

    def parameters(self) -> tuple[float, ...]:
        return 4 / 3 * self.mu, self.lam + 5 / 6 * self.mu

    def block(self) -> Block:
        """a = 9/8 μ', b = λ': the largest curvature of |F|² - log(1 + |F|²) along a line is 9/4."""
        mu_s, lam_s = self.parameters()
        return Block(9 / 8 * mu_s, lam_s)
