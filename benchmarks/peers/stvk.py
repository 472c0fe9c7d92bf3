"""Saint Venant-Kirchhoff elasticity, which MuJoCo's flex and pypbd solve, as a user material of pbng."""

import pbng
from pbng.linalg import identity, mat_combine, mat_mul, mat_scale, norm2, trace, transpose


@pbng.material
class StVK(pbng.Material):
    """Ψ = μ |G|² + λ/2 (tr G)² with Green's strain G = (FᵀF - I) / 2; quartic in F, weak in compression.

    Its curvature grows without bound, so no two numbers majorise it. Its block is the paper's, right near rest;
    pbng relaxes sweeps that raise the energy.
    """

    def energy(F, mu, lam):
        real = type(mu)
        G = mat_scale(real(0.5), mat_combine(real(1), mat_mul(transpose(F), F), real(-1), identity(mu)))
        tr = trace(G)
        return mu * norm2(G) + real(0.5) * lam * tr * tr

    def stress(F, mu, lam):
        real = type(mu)
        G = mat_scale(real(0.5), mat_combine(real(1), mat_mul(transpose(F), F), real(-1), identity(mu)))
        return mat_mul(F, mat_combine(real(2) * mu, G, lam * trace(G), identity(mu)))
