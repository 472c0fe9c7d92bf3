"""Materials of a user's own, for tests, and NumPy twins of every model: the oracle's side of the comparison."""

import math

import numpy as np

import pbng
from pbng.materials.invariants import InvariantMaterial


@pbng.material
class SoftVolume(pbng.Material):
    """A user's material by stress: Ψ = μ/2 (|F|² - 3) - μ (J - 1) + (μ + λ) (sqrt(1 + (J - 1)²) - 1).

    Neo-Hookean with a volume term that grows linearly; v'' <= μ + λ, so a = μ, b = μ + λ is a majoriser.
    """

    def energy(F, mu, k):
        real = type(mu)
        dJ = pbng.linalg.det(F) - real(1)
        growth = real(0.5) * (pbng.linalg.norm2(F) - real(3))
        return mu * (growth - dJ) + k * (math.sqrt(real(1) + dJ * dJ) - real(1))

    def stress(F, mu, k):
        real = type(mu)
        dJ = pbng.linalg.det(F) - real(1)
        p = k * dJ / math.sqrt(real(1) + dJ * dJ) - mu
        return pbng.linalg.mat_combine(mu, F, p, pbng.linalg.cofactor(F))

    def parameters(self):
        return self.mu, self.mu + self.lam

    def block(self):
        return pbng.Block(self.mu, self.mu + self.lam)


@pbng.material
class RootMooney(InvariantMaterial):
    """A user's material by invariants that uses all three: Ψ̂ = c I0 + q sqrt(I1) + k/2 (I2 - 1)² - (2c + 2q/√3) I2.

    ``share`` of the shear modulus comes from sqrt(I1) = |FᵀF|, whose curvature along any line is at most 6 |D|².
    """

    share: float = 0.4

    def invariant_energy(I0, I1, I2, c, q, p, k):
        real = type(c)
        dJ = I2 - real(1)
        return c * (I0 - real(3)) + q * (math.sqrt(I1) - math.sqrt(real(3))) + (real(0.5) * k * dJ - p) * dJ

    def invariant_derivatives(I0, I1, I2, c, q, p, k):
        real = type(c)
        return c, real(0.5) * q / math.sqrt(max(I1, real(1e-30))), k * (I2 - real(1)) - p

    def parameters(self):
        root = math.sqrt(3)
        c, q = (1 - self.share) * self.mu / 2, self.share * self.mu * root / 4
        p = 2 * c + 2 * q / root
        return c, q, p, self.lam + p + 4 * q / (3 * root)

    def block(self):
        c, q, _, k = self.parameters()
        return pbng.Block(2 * c + 6 * q, k)


@pbng.material
class Yeoh(InvariantMaterial):
    """Ψ̂ = μ/2 (I0 - 3) + c2 (I0 - 3)² - μ (I2 - 1) + (λ + μ - 8 c2)/2 (I2 - 1)², with the paper's block by default.

    Quartic in F: no constant block majorises it.
    """

    c2: float = 0.0

    def invariant_energy(I0, I1, I2, mu, c2, k):
        real = type(mu)
        growth, dJ = I0 - real(3), I2 - real(1)
        return (real(0.5) * mu + c2 * growth) * growth + (real(0.5) * k * dJ - mu) * dJ

    def invariant_derivatives(I0, I1, I2, mu, c2, k):
        real = type(mu)
        return real(0.5) * mu + real(2) * c2 * (I0 - real(3)), real(0), k * (I2 - real(1)) - mu

    def parameters(self):
        return self.mu, self.c2, self.lam + self.mu - 8 * self.c2


def cof(F):
    a, b, c = F[..., :, 0], F[..., :, 1], F[..., :, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)


def polar(F):
    """The rotation of F by SVD, det R = +1 always."""
    U, _, V = np.linalg.svd(F)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ V))[..., None]
    return U @ V


def oracle_stress(m, F):
    """P (n, 3, 3) at F (n, 3, 3), written from the formulas of method.md."""
    J = np.linalg.det(F)[:, None, None]
    norm2 = (F * F).sum((1, 2))[:, None, None]
    mu, lam, one = m.mu, m.lam, np.eye(3)
    if isinstance(m, pbng.Corotated):
        return 2 * mu * (F - polar(F)) + lam * (J - 1) * cof(F)
    if isinstance(m, pbng.NeoHookean):
        return mu * F + ((lam + mu) * (J - 1) - mu) * cof(F)
    if isinstance(m, pbng.StableNeoHookean):
        mu_s, lam_s = 4 / 3 * mu, lam + 5 / 6 * mu
        return mu_s * (1 - 1 / (1 + norm2)) * F + lam_s * (J - 1 - 3 * mu_s / (4 * lam_s)) * cof(F)
    if isinstance(m, pbng.LinearElastic):
        eps = (F + F.transpose(0, 2, 1)) / 2 - one
        return 2 * mu * eps + lam * np.trace(eps, axis1=1, axis2=2)[:, None, None] * one
    if isinstance(m, SoftVolume):
        return mu * F + ((lam + mu) * (J - 1) / np.sqrt(1 + (J - 1) ** 2) - mu) * cof(F)
    if isinstance(m, RootMooney):
        c, q, p, k = m.parameters()
        C = F.transpose(0, 2, 1) @ F
        return 2 * c * F + 2 * q / np.linalg.norm(C, axis=(1, 2))[:, None, None] * F @ C + (k * (J - 1) - p) * cof(F)
    raise TypeError(f"no oracle for {m!r}")


@pbng.material
class StVK(pbng.Material):
    """Saint Venant-Kirchhoff: Ψ = μ |G|² + λ/2 (tr G)² with G = (FᵀF - I)/2, quartic in F; with the paper's block."""

    def energy(F, mu, lam):
        real = type(mu)
        C = pbng.linalg.mat_mul(pbng.linalg.transpose(F), F)
        G = pbng.linalg.mat_scale(real(0.5), pbng.linalg.mat_sub(C, pbng.linalg.identity(mu)))
        tr = pbng.linalg.trace(G)
        return mu * pbng.linalg.norm2(G) + real(0.5) * lam * tr * tr

    def stress(F, mu, lam):
        real = type(mu)
        one = pbng.linalg.identity(mu)
        G = pbng.linalg.mat_scale(real(0.5), pbng.linalg.mat_sub(pbng.linalg.mat_mul(pbng.linalg.transpose(F), F), one))
        return pbng.linalg.mat_mul(F, pbng.linalg.mat_combine(real(2) * mu, G, lam * pbng.linalg.trace(G), one))
