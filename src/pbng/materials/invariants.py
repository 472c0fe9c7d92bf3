"""Isotropic materials given through invariants of F, Eqs. (40)-(41): a scalar function and its three derivatives."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from pbng.errors import InputError
from pbng.jit import function, inline
from pbng.linalg import cofactor, combine3, det, dot, mat_mul, norm2
from pbng.materials.base import Material


@dataclass(frozen=True, kw_only=True)
class InvariantMaterial(Material):
    """Base of a material Ψ(F) = Ψ̂(I0, I1, I2), I0 = tr FᵀF, I1 = tr (FᵀF)², I2 = det F.

    A subclass defines two functions without ``self``, of the invariants and the model's own parameters, and is
    decorated with :func:`pbng.material`; energy and stress are made from them::

        invariant_energy(I0, I1, I2, *parameters) -> Ψ̂ [J/m³], zero at rest, where (I0, I1, I2) = (3, 3, 1)
        invariant_derivatives(I0, I1, I2, *parameters) -> (∂Ψ̂/∂I0, ∂Ψ̂/∂I1, ∂Ψ̂/∂I2) [Pa]

    With d0, d1, d2 for the derivatives, the stress P = 2 d0 F + 4 d1 F FᵀF + d2 cof F vanishes at rest if
    2 d0 + 4 d1 + d2 = 0 there, and the model agrees with linear elasticity if μ = 2 d0 + 8 d1 and
    λ = d2 + Σ v_i v_j ∂²Ψ̂/∂I_i∂I_j with v = (2, 4, 1). :func:`pbng.check_material` checks all of this.

    **The block.** Without a ``block`` of its own a model gets the paper's, a = 2μ, b = λ (Eq. 32). Displace one node by
    u: I2 is affine, with slope c·u, and I0 quadratic, with curvature 2 |g|² |u|². So for Ψ̂ = φ(I0) + v(I2) with φ
    concave the block a = 2 max φ', b = max v'' majorises the energy from any state. The paper's does not: for such a
    model agreement at rest makes v'' = λ + μ or more, and 2μ, λ covers that only while |cof(F) g| <= |g|, that is while
    the face across from the node is no larger than at rest. At rest it bounds every model's Hessian. I1 is quartic in
    u: where it, or a power of I0, makes Ψ grow faster than |F|², no two constants serve every state; take those that
    bound the second derivatives over the stretches expected; :func:`pbng.check_material` tells where they hold.
    """

    invariant_energy: ClassVar[Callable[..., float]]
    invariant_derivatives: ClassVar[Callable[..., tuple[float, float, float]]]

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        names = ("invariant_energy", "invariant_derivatives")
        for name in names:
            own = vars(cls).get(name)
            if own is not None:
                plain = own.__func__ if isinstance(own, staticmethod) else own
                setattr(cls, name, staticmethod(plain if hasattr(plain, "py_func") else function(plain)))
            elif not hasattr(cls, name):
                raise InputError(f"material {cls.__name__} defines no {name}(I0, I1, I2, *parameters)")
        if any(name in vars(cls) for name in names):
            cls.energy = staticmethod(_energy(cls.invariant_energy))
            cls.stress = staticmethod(_stress(cls.invariant_derivatives))


@inline
def _right_cauchy_green(F):
    """C = FᵀF as columns."""
    xx, yy, zz = dot(F[0], F[0]), dot(F[1], F[1]), dot(F[2], F[2])
    xy, xz, yz = dot(F[0], F[1]), dot(F[0], F[2]), dot(F[1], F[2])
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _energy(psi: Callable[..., Any]) -> Any:
    """Ψ(F) of Ψ̂, Eq. (41)."""

    @function
    def energy(F, *parameters):
        return psi(norm2(F), norm2(_right_cauchy_green(F)), det(F), *parameters)

    return energy


def _stress(derivatives: Callable[..., Any]) -> Any:
    """P = 2 d0 F + 4 d1 F FᵀF + d2 cof F, the chain rule of Eq. (41)."""

    @function
    def stress(F, *parameters):
        C = _right_cauchy_green(F)
        H = cofactor(F)
        d0, d1, d2 = derivatives(norm2(F), norm2(C), dot(F[2], H[2]), *parameters)
        two = type(F[0][0])(2)
        a, b = two * d0, two * two * d1
        FC = mat_mul(F, C)
        return (
            combine3(a, F[0], b, FC[0], d2, H[0]),
            combine3(a, F[1], b, FC[1], d2, H[1]),
            combine3(a, F[2], b, FC[2], d2, H[2]),
        )

    return stress
