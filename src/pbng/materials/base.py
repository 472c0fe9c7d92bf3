"""What a material is: a stress, an energy and the two numbers of its majorising block.

Everything else (lanes, colours, precisions, element kinds) is the library's business: the functions below are compiled
into the same kernels whether they come with pbng or from a user.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar, NamedTuple, TypeVar, dataclass_transform

from pbng.errors import InputError
from pbng.jit import function


class Block(NamedTuple):
    """The numbers of the block A_i = Σ_e V_e (a |g_i|² I + b c cᵀ), c = cof(F) g_i (method.md, Eqs. 30-34).

    With ``at_rest`` c is g_i instead, its value at F = I, which suits a quadratic energy.
    """

    a: float
    b: float
    at_rest: bool = False


class ConstraintForm(NamedTuple):
    """An energy density as a sum of squares, Ψ = Σ k/2 C² + constant, which XPBD needs (Eq. 21); up to rotations of the
    rest state.

    ``functions`` are compiled, ``(F, *parameters) -> C, ∂C/∂F`` with the parameters of ``energy``; ``stiffness`` holds
    each k [Pa], one over compliance and volume. PBD, which takes every k for infinite, needs ``met_at_rest``: C(I) = 0.
    """

    functions: tuple[Callable[..., Any], ...]
    stiffness: tuple[float, ...]
    met_at_rest: bool = True


@dataclass(frozen=True, kw_only=True)
class Material:
    """Base of every material of solids and surfaces.

    A subclass defines two functions of the deformation gradient F (a tuple of three columns, see :mod:`pbng.linalg`)
    and of the model's own parameters, both without ``self``::

        energy(F, *parameters) -> Ψ [J/m³], zero at rest
        stress(F, *parameters) -> P = ∂Ψ/∂F [Pa], a tuple of three columns

    and the methods ``parameters`` and ``block``. Decorate it with :func:`material`. A third function is optional and
    only for Newton's method, which otherwise takes differences of the stress::

        hessian(F, D, *parameters) -> δP = ∂P/∂F : D [Pa], the change of the stress along D = δF

    Args:
        E: Young's modulus [Pa].
        nu: Poisson's ratio, in (-1, 0.5).
        density: Mass density [kg/m³] (per area [kg/m²] for plane domains of unit thickness).
    """

    E: float
    nu: float
    density: float = 1000.0

    surface: ClassVar[bool] = False  # F has two columns, Ψ is per area [J/m²]: for triangles in space (cloth)
    isotropic: ClassVar[bool] = True  # Ψ(F Q) = Ψ(F) for rotations Q; lets the kernels choose the material frame
    energy: ClassVar[Callable[..., float]]
    stress: ClassVar[Callable[..., Any]]

    def __post_init__(self) -> None:
        name = type(self).__name__
        if not (math.isfinite(self.E) and self.E > 0):
            raise InputError(f"{name}: Young's modulus E must be positive and finite, not {self.E}")
        if not -1 < self.nu < 0.5:
            raise InputError(f"{name}: Poisson's ratio nu must lie strictly between -1 and 0.5, not {self.nu}")
        if not (math.isfinite(self.density) and self.density >= 0):
            raise InputError(f"{name}: density must be finite and not negative, not {self.density}")
        block = self.block()
        if not (math.isfinite(block.a) and math.isfinite(block.b) and block.a > 0 and block.b >= 0):
            raise InputError(f"{name}: the block needs finite a > 0 and b >= 0, not a={block.a}, b={block.b}")

    @cached_property
    def mu(self) -> float:
        """Lamé's shear modulus μ [Pa], Eq. (9)."""
        return self.E / (2 * (1 + self.nu))

    @cached_property
    def lam(self) -> float:
        """Lamé's λ [Pa], Eq. (9)."""
        return self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))

    def parameters(self) -> tuple[float, ...]:
        """What ``energy`` and ``stress`` get after F; by default (μ, λ)."""
        return self.mu, self.lam

    def block(self) -> Block:
        """The majorising block, for which no node update raises the energy; by default the paper's, Eq. (32)."""
        return self.paper_block()

    def paper_block(self) -> Block:
        """The block a = 2μ, b = λ that the paper uses for every model, Eq. (32)."""
        return Block(2 * self.mu, max(self.lam, 0.0))

    def constraints(self) -> ConstraintForm | None:
        """The model as constraints, for XPBD and PBD; None if it has no such form."""
        return None


class Model(NamedTuple):
    """The compiled functions of a material class, as the kernels see them; ``hessian`` only if the class has one."""

    name: str
    energy: Callable[..., Any]
    stress: Callable[..., Any]
    n_parameters: int
    isotropic: bool
    hessian: Callable[..., Any] | None = None


@cache
def model_of(cls: Any, n_parameters: int) -> Model:
    """The model of a material class; compiled when a kernel first needs it."""
    energy, stress = _compiled(cls, "energy"), _compiled(cls, "stress")
    hessian = _compiled(cls, "hessian") if has_hessian(cls) else None
    return Model(cls.__name__, energy, stress, n_parameters, cls.isotropic, hessian)


def has_hessian(cls: type) -> bool:
    """Whether a material class has a Hessian of its stress: not one of a base whose stress it has replaced."""
    for base in cls.__mro__:
        if vars(base).get("hessian") is not None:
            return True
        if "stress" in vars(base):
            return False
    return False


def _compiled(cls: type[Material], name: str) -> Callable[..., Any]:
    own = getattr(cls, name, None)
    if own is None:
        raise InputError(f"material {cls.__name__} defines no {name}(F, *parameters)")
    return own if hasattr(own, "py_func") else function(own)


M = TypeVar("M", bound=type)


@dataclass_transform(frozen_default=True, kw_only_default=True)
def material(cls: M) -> M:
    """Class decorator that makes a material of one's own; see :class:`Material` and ``docs/materials.md``.

    The class becomes a frozen dataclass with E, nu and density besides its own fields, and ``energy``, ``stress`` and
    ``hessian`` become functions that compiled code can call. Check it with :func:`pbng.check_material`.
    """
    if not issubclass(cls, Material):
        body = {k: v for k, v in vars(cls).items() if k not in ("__dict__", "__weakref__")}
        cls = type(cls.__name__, (Material,), body)  # type: ignore[assignment]
    for name in ("energy", "stress", "hessian"):
        own = vars(cls).get(name)
        if own is not None:
            plain = own.__func__ if isinstance(own, staticmethod) else own
            setattr(cls, name, staticmethod(plain if hasattr(plain, "py_func") else function(plain)))
    made: Any = dataclass(frozen=True, kw_only=True)(cls)
    return made
