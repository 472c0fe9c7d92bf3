"""Looking at runs: pictures, films, strips and plots. Needs ``pbng[view]``, imported only when something is drawn."""

import sys
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from pbng.errors import InputError

if TYPE_CHECKING:
    from pbng.view.plots import plot_residuals
    from pbng.view.render import film, picture, sheet, view

__all__ = ["film", "picture", "plot_residuals", "sheet", "view"]


def _need(*packages: str) -> None:
    missing = [p for p in packages if find_spec(p) is None]
    if missing:
        raise InputError(f"pictures need {' and '.join(missing)}: pip install 'pbng[view]'")


def __getattr__(name: str) -> Any:
    if name == "plot_residuals":
        _need("matplotlib")
        from pbng.view import plots

        return plots.plot_residuals
    if name in __all__:
        _need("pyvista", "matplotlib")
        from pbng.view import render

        return getattr(render, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class _Callable(ModuleType):
    """``pbng.view`` is a function of the package and this module; whichever of the two was loaded first, both work."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        return __getattr__("view")(*args, **options)


sys.modules[__name__].__class__ = _Callable
