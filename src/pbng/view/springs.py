"""Weak constraints as thin lines between the points that they tie together, and other lines and colours laid over.

Drawn here rather than by the renderer, whose lines differ from machine to machine. They are laid over the finished
picture, so that no light or shade takes their colour, where the depth image says that nothing is in front of them.
"""

import numpy as np

from pbng.jit import serial
from pbng.view.camera import VIEW_ANGLE, Camera

COLOR = (36, 150, 70)  # a green that neither the map of stretch nor the palette of bodies has
FEW, MOST = 60, 500  # so many lines are few; so many are drawn at most
WIDTHS = 2.2, 1.3  # [pixels of a picture 720 high] of few and of most lines
THINNEST = 1.0  # [pixels]
LITTLE, MUCH = 0.03, 0.2  # shares of a picture covered by lines
OPACITIES = 1.0, 0.4  # of a line, where they cover little and much
LOOKED_AT = 20_000  # so many are chosen from


class Springs:
    """Lays the weak constraints of frames over their images.

    Of very many only a part is drawn, the same in all frames: those far apart in the first. The more there are, the
    thinner they are, and the more of a picture they cover, the more they let through.

    Args:
        first: Ends (m, 2, 3) [m] of the weak constraints in the first frame.
    """

    def __init__(self, first: np.ndarray) -> None:
        self.count, self.chosen = len(first), apart(first, MOST)
        many = np.clip(len(self.chosen), FEW, MOST)
        self.width = float(np.interp(np.log(many), np.log([FEW, MOST]), WIDTHS))

    def draw(self, image: np.ndarray, depth: np.ndarray, camera: Camera, springs: np.ndarray) -> None:
        """Draw springs into an image (h, w, 3) uint8, in place.

        Args:
            image: The picture.
            depth: Distance (k h, k w) float32 [m] along the camera's axis of what is in it, k by k samples a pixel.
            camera: From where it is seen.
            springs: Ends (m, 2, 3) [m] of all weak constraints of the frame.
        """
        springs = springs[self.chosen if len(springs) == self.count else apart(springs, MOST)]
        lay_lines(image, depth, camera, springs, self.width, COLOR)


def lay_lines(
    image: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    ends: np.ndarray,
    width: float,
    color: tuple[int, int, int],
    opacity: float | None = None,
) -> None:
    """Draw lines with ends (m, 2, 3) [m] into an image (h, w, 3) uint8, in place, where nothing is before them.

    Args:
        image, depth, camera: As for :meth:`Springs.draw`.
        ends: Those that are not finite are left out.
        width: Of the lines [pixels of a picture 720 high].
        color: Theirs.
        opacity: Theirs; by default the less, the more of the picture they cover.
    """
    ends = ends[np.isfinite(ends).all((1, 2))]
    height, across = depth.shape
    places = camera.seen(ends.reshape(-1, 3), (across, height)).reshape(-1, 2, 3)
    sampling = height // image.shape[0]
    half = sampling * max(THINNEST, width * image.shape[0] / 720) / 2
    if opacity is None:
        covered = 2 * half * np.linalg.norm(places[:, 1, :2] - places[:, 0, :2], axis=1).sum() / depth.size
        opacity = float(np.interp(np.log(max(covered, LITTLE)), np.log([LITTLE, MUCH]), OPACITIES))
    parallel = camera.parallel is not None
    # Width of a sample: in a plane of given depth, or at a distance of 1.
    sample = 2 * (camera.parallel or np.tan(np.radians(VIEW_ANGLE) / 2)) / height
    through = np.ones_like(depth)
    _draw(places, half, opacity, sample, parallel, depth, through)
    lay(image, through, sampling, np.array(color, float), (1 + opacity) / 2)


def apart(springs: np.ndarray, most: int) -> np.ndarray:
    """Which at most so many springs (m, 2, 3) are spread most evenly: each is the one farthest from those before."""
    if len(springs) <= most:
        return np.arange(len(springs))
    among = np.unique(np.linspace(0, len(springs) - 1, min(len(springs), LOOKED_AT)).round().astype(int))
    places = np.nan_to_num(springs[among].reshape(-1, 6), posinf=0.0, neginf=0.0)
    # On a regular grid very many are equally far; taken in order, they would leave one side full and the other empty.
    noise = np.random.default_rng(0).uniform(-1, 1, places.shape)
    places = places + 0.02 * np.linalg.norm(np.ptp(places, axis=0)) * noise
    distance = np.full(len(among), np.inf)
    chosen = [0]
    while len(chosen) < most:
        distance = np.minimum(distance, ((places - places[chosen[-1]]) ** 2).sum(1))
        distance[chosen] = -1.0  # none twice, also where many coincide
        chosen.append(int(distance.argmax()))
    return among[np.sort(chosen)]


@serial
def _draw(places, half, opacity, sample, parallel, depth, through):
    """Of each sample, reduce what lines of half a width [samples] let through (h, w).

    Places (m, 2, 3) are columns, rows and depths [m] of their ends. These are cut square, so that a line without length
    covers nothing.
    """
    h, w = depth.shape
    reach = half + 1.0
    for s in range(places.shape[0]):
        ax, ay, az = places[s, 0]
        bx, by, bz = places[s, 1]
        length = np.hypot(bx - ax, by - ay)
        if not 1e-6 < length < 1e9 or az <= 0.0 or bz <= 0.0:
            continue
        ux, uy = (bx - ax) / length, (by - ay) / length
        for row in range(int(max(0.0, np.floor(min(ay, by) - reach))), int(min(h - 1.0, max(ay, by) + reach)) + 1):
            # The part of the line whose rows are near this one.
            t0, t1 = 0.0, length
            if abs(uy) > 1e-9:
                low, high = (row + 0.5 - reach - ay) / uy, (row + 0.5 + reach - ay) / uy
                t0, t1 = max(t0, min(low, high)), min(t1, max(low, high))
            left, right = ax + min(t0 * ux, t1 * ux), ax + max(t0 * ux, t1 * ux)
            first = int(max(0.0, np.floor(left - reach)))
            last = int(min(w - 1.0, right + reach))
            for column in range(first, last + 1):
                px, py = column + 0.5 - ax, row + 0.5 - ay
                along = px * ux + py * uy
                cover = min(1.0, max(0.0, along + 0.5)) + min(1.0, max(0.0, length - along + 0.5)) - 1.0
                cover = min(cover, half + 0.5 - abs(px * uy - py * ux))
                if cover <= 0.0:
                    continue
                # Straight lines stay so in perspective, but depth along them is linear in its inverse only. They are
                # as thick as they are wide: what lies in the very surface is seen.
                t = min(1.0, max(0.0, along / length))
                if parallel:
                    front = (1.0 - t) * az + t * bz - half * sample
                else:
                    front = (1.0 - half * sample) / ((1.0 - t) / az + t / bz)
                if front <= depth[row, column]:
                    through[row, column] *= 1.0 - opacity * cover


@serial
def lay(image, through, k, color, most):
    """Lay a colour over an image (h, w, 3) where not all of the samples (k h, k w) is let through.

    However many lines there are, no more than ``most`` of what is behind them is lost.
    """
    h, w = image.shape[:2]
    for i in range(h):
        for j in range(w):
            total = 0.0
            for p in range(k * i, k * i + k):
                for q in range(k * j, k * j + k):
                    total += min(most, 1.0 - through[p, q])
            if total > 0.0:
                alpha = total / (k * k)
                for c in range(3):
                    image[i, j, c] = np.uint8(image[i, j, c] * (1.0 - alpha) + color[c] * alpha + 0.5)
