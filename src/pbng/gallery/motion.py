"""Motions that start and stop gently, as films want them."""

from dataclasses import dataclass

import numpy as np

from pbng.motions import Affine, Motion


@dataclass(frozen=True)
class Eased(Motion):
    """Another motion, from rest to rest: the share s of it that is done becomes s² (3 - 2 s)."""

    motion: Motion

    def at(self, X: np.ndarray, center: np.ndarray, s: float, t: float) -> np.ndarray:
        return self.motion.at(X, center, _eased(s), t)


@dataclass(frozen=True)
class ThereAndBack(Affine):
    """Another motion, such as a collider can have, and then the same backwards, each half from rest to rest."""

    motion: Affine

    def linear(self, s: float) -> np.ndarray:
        return self.motion.linear(_eased(1 - abs(2 * s - 1)))

    def shift(self, s: float, center: np.ndarray) -> np.ndarray:
        return self.motion.shift(_eased(1 - abs(2 * s - 1)), center)


def _eased(s: float) -> float:
    return s * s * (3 - 2 * s)
