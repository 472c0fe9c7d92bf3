"""Equilibria of soft bodies and cloth by position-based nonlinear Gauss-Seidel.

The public names are those of ``__init__.pyi``; they are loaded on first use, so that ``import pbng`` and the command
line start at once.
"""

import lazy_loader

__version__ = "0.1.0.dev0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
