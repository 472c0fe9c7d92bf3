"""Looking at pictures: what tests of them share."""

import numpy as np

from pbng import view

SIZE = (320, 180)


def read(path):
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def body_pixels(image):
    """Pixels of saturated colour: the background, the floor and shadows are grey."""
    return np.ptp(image, axis=2) > 30


def assert_well_framed(image, size, least=0.08, most=0.75):
    assert image.shape == (size[1], size[0], 3)
    body = body_pixels(image)
    assert least < body.mean() < most
    edge = max(2, size[1] // 40)
    inner = np.zeros_like(body)
    inner[edge:-edge, edge:-edge] = True
    assert not body[~inner].any(), "a body is cropped"
    assert image[body].sum(1).min() > 90, "a face is black"
    assert (image[:edge] > 235).all(), "the background is light"


def drawn(source, tmp_path, size=(480, 480), **options):
    return read(view.picture(source, tmp_path / "a.png", size=size, color="body", **options))
