"""Random textures and ArUco markers as PNG files."""

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
_SIDE_PX = 256


def draw_textures(object_texture: str | None, seed: int, table_seed: int) -> dict[str, bytes]:
    """Draws the texture of the table and, if it has one, of the object.

    Args:
        object_texture: File name of the object's texture, or None.
        seed: Seed of the object's texture.
        table_seed: Seed of the table's texture.

    Returns:
        File name to content of a PNG file.
    """
    images = {"table.png": _table(np.random.default_rng(table_seed))}
    if object_texture is not None:
        rng = np.random.default_rng(seed)
        _table(rng)  # the table was once drawn first from this seed; without this, textures would change
        images[object_texture] = _paint(object_texture, rng)
    return {name: cv2.imencode(".png", image)[1].tobytes() for name, image in images.items()}


def draw_markers() -> dict[str, bytes]:
    """Draws the ArUco markers 0 and 1, each with its quiet zone.

    Returns:
        File name to content of a PNG file.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    images = {
        f"marker_{i}.png": np.pad(cv2.aruco.generateImageMarker(dictionary, i, 192), 32, constant_values=255)
        for i in (0, 1)
    }
    return {name: cv2.imencode(".png", image)[1].tobytes() for name, image in images.items()}


def _clouds(rng: np.random.Generator, sigma: float) -> npt.NDArray[np.float32]:
    noise = rng.standard_normal((_SIDE_PX, _SIDE_PX)).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma, borderType=cv2.BORDER_REFLECT), np.float32)
    scaled: npt.NDArray[np.float32] = smooth / smooth.std()
    return scaled


def _colour(gray: npt.NDArray[np.floating], blue: float, green: float, red: float) -> Image:
    return np.clip(gray[..., None] * [blue, green, red], 0, 255).astype(np.uint8)


def _table(rng: np.random.Generator) -> Image:
    return _colour(rng.uniform(85, 125) + 14 * _clouds(rng, rng.uniform(2, 5)), 1, 1, 1)


def _sponge(rng: np.random.Generator) -> Image:
    gray = np.ascontiguousarray(175 + 21 * _clouds(rng, 6) + 21 * _clouds(rng, 2))
    for _ in range(170):
        x, y = (int(v) for v in rng.integers(0, _SIDE_PX, 2))
        pore = int(rng.integers(2, 6))
        axes = (pore, max(1, int(pore * rng.uniform(0.5, 1))))
        shade = float(rng.uniform(50, 95))
        cv2.ellipse(gray, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
    return _colour(np.clip(gray, 0, 255), 0.35, 0.9, 1)


def _cup(rng: np.random.Generator) -> Image:
    image = np.full((_SIDE_PX, _SIDE_PX, 3), 235, np.uint8)
    for top, bottom in ((0.30, 0.36), (0.74, 0.77)):
        cv2.rectangle(image, (0, int(top * _SIDE_PX)), (_SIDE_PX, int(bottom * _SIDE_PX)), (90, 60, 40), -1)
    turn, motifs = rng.uniform(0, 1), 8
    for i in range(motifs):
        x = int((i + turn) * _SIDE_PX / motifs)
        cv2.circle(image, (x, int(0.55 * _SIDE_PX)), int(0.038 * _SIDE_PX), (60, 90, 180), -1, cv2.LINE_AA)
        leaf = (int(0.03 * _SIDE_PX), int(0.08 * _SIDE_PX))
        cv2.ellipse(image, (x, int(0.16 * _SIDE_PX)), leaf, 20, 0, 360, (80, 140, 80), -1, cv2.LINE_AA)
        cv2.line(image, (x + 14, int(0.40 * _SIDE_PX)), (x + 14, int(0.70 * _SIDE_PX)), (150, 150, 150), 2)
    return image


def _tube(rng: np.random.Generator) -> Image:
    image = np.full((_SIDE_PX, _SIDE_PX, 3), (150, 165, 160), np.uint8)
    turn = rng.uniform(0, 1)
    for i in range(8):  # lines along the axis show the deformation of the section
        x = int((i + turn) * _SIDE_PX / 8)
        cv2.line(image, (x, 0), (x, _SIDE_PX), (70, 80, 75), 3)
    for j in range(6):  # rings show bending
        y = int((j + 0.5) * _SIDE_PX / 6)
        cv2.line(image, (0, y), (_SIDE_PX, y), (215, 220, 215), 5)
    return image


def _ball(rng: np.random.Generator) -> Image:
    image = np.full((_SIDE_PX, _SIDE_PX, 3), (60, 130, 200), np.uint8)
    bands = _clouds(rng, 14)
    image[np.abs(bands) < 0.35] = (200, 220, 235)
    image[bands > 1.1] = (60, 60, 70)
    return image


def _paint(file_name: str, rng: np.random.Generator) -> Image:
    if file_name in _OBJECT_TEXTURES:
        return _OBJECT_TEXTURES[file_name](rng)
    pattern = PATTERNS[file_name.removesuffix(".png")]
    shade = rng.uniform(60, 220)
    # Contrast of at least a quarter of the range, to the side where there is room.
    other = shade + (-1 if shade > 140 else 1) * rng.uniform(50, 110)
    gray = shade + (other - shade) * pattern(rng) + rng.uniform(2, 10) * _clouds(rng, rng.uniform(1, 8))
    return _colour(gray, *rng.uniform(0.8, 1.1, 3))


def _grid() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    rows, columns = np.mgrid[:_SIDE_PX, :_SIDE_PX].astype(np.float32) / _SIDE_PX
    return columns, rows


def _bands(rng: np.random.Generator, across: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
    """Returns 0 to 1: bands with soft edges; whole periods, so that the ends of a wall meet."""
    wave = np.sin(2 * np.pi * (int(rng.integers(5, 11)) * across + rng.uniform()))
    bands: npt.NDArray[np.floating] = np.clip(0.5 + 4 * (wave - rng.uniform(-0.5, 0.5)), 0, 1)
    return bands


def _spots(rng: np.random.Generator, largest_px: int) -> npt.NDArray[np.floating]:
    gray = np.zeros((_SIDE_PX, _SIDE_PX), np.float32)
    for _ in range(int(4000 / largest_px**1.5)):
        x, y = (int(v) for v in rng.integers(0, _SIDE_PX, 2))
        radius = max(1, int(largest_px * rng.uniform(0.4, 1)))
        cv2.circle(gray, (x, y), radius, float(rng.uniform(0.5, 1)), -1, cv2.LINE_AA)
    return gray


def _label(rng: np.random.Generator) -> npt.NDArray[np.floating]:
    gray = np.zeros((_SIDE_PX, _SIDE_PX), np.float32)
    low, high = (int(_SIDE_PX * share) for share in (rng.uniform(0.15, 0.3), rng.uniform(0.7, 0.85)))
    cv2.rectangle(gray, (0, low), (_SIDE_PX, high), 0.8, -1)
    for _ in range(14):  # lines of print
        x, y = int(rng.integers(0, _SIDE_PX)), int(rng.integers(low, high))
        cv2.rectangle(gray, (x, y), (x + int(rng.integers(10, 60)), y + int(rng.integers(3, 14))), 0.1, -1)
    return gray


_OBJECT_TEXTURES = {"sponge.png": _sponge, "cup.png": _cup, "tube.png": _tube, "ball.png": _ball}

PATTERNS: dict[str, Callable[[np.random.Generator], npt.NDArray[np.floating]]] = {
    "stripes": lambda rng: _bands(rng, _grid()[0]),
    "rings": lambda rng: _bands(rng, _grid()[1]),
    "checks": lambda rng: np.abs(_bands(rng, _grid()[0]) - _bands(rng, _grid()[1])),
    "weave": lambda rng: 0.5 * (_bands(rng, _grid()[0] + _grid()[1]) + _bands(rng, _grid()[0] - _grid()[1])),
    "spots": lambda rng: _spots(rng, 14),
    "speckle": lambda rng: _spots(rng, 4),
    "marble": lambda rng: np.clip(0.5 + 1.5 * _clouds(rng, rng.uniform(8, 16)), 0, 1),
    "label": _label,
    "plain": lambda _: np.zeros((_SIDE_PX, _SIDE_PX), np.float32),
}
"""Patterns of the kinds of objects, from 0 to 1; shade and contrast are drawn."""
