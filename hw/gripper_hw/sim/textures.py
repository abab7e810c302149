"""Textures drawn from a seed."""

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
_SIDE = 256


def draw_textures(object_texture: str | None, seed: int, table_seed: int) -> dict[str, bytes]:
    """PNG files by name: the table and, if the object has one, its own."""
    images = {"table.png": _table(np.random.default_rng(table_seed))}
    if object_texture is not None:
        rng = np.random.default_rng(seed)
        _table(rng)  # objects of one seed keep their texture: this was once the only table
        images[object_texture] = _OF_OBJECTS[object_texture](rng)
    return {name: cv2.imencode(".png", image)[1].tobytes() for name, image in images.items()}


def draw_markers() -> dict[str, bytes]:
    """PNG files by name: the ArUco markers 0 and 1, each in its quiet zone."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    sheets = {
        f"marker_{i}.png": np.pad(cv2.aruco.generateImageMarker(dictionary, i, 192), 32, constant_values=255)
        for i in (0, 1)
    }
    return {name: cv2.imencode(".png", sheet)[1].tobytes() for name, sheet in sheets.items()}


def _clouds(rng: np.random.Generator, sigma: float) -> npt.NDArray[np.float32]:
    noise = rng.standard_normal((_SIDE, _SIDE)).astype(np.float32)
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
        x, y = (int(v) for v in rng.integers(0, _SIDE, 2))
        pore = int(rng.integers(2, 6))
        axes = (pore, max(1, int(pore * rng.uniform(0.5, 1))))
        shade = float(rng.uniform(50, 95))
        cv2.ellipse(gray, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, shade, -1, cv2.LINE_AA)
    return _colour(np.clip(gray, 0, 255), 0.35, 0.9, 1)


def _cup(rng: np.random.Generator) -> Image:
    image = np.full((_SIDE, _SIDE, 3), 235, np.uint8)
    for top, bottom in ((0.30, 0.36), (0.74, 0.77)):
        cv2.rectangle(image, (0, int(top * _SIDE)), (_SIDE, int(bottom * _SIDE)), (90, 60, 40), -1)
    turn, motifs = rng.uniform(0, 1), 8
    for i in range(motifs):
        x = int((i + turn) * _SIDE / motifs)
        cv2.circle(image, (x, int(0.55 * _SIDE)), int(0.038 * _SIDE), (60, 90, 180), -1, cv2.LINE_AA)
        leaf = (int(0.03 * _SIDE), int(0.08 * _SIDE))
        cv2.ellipse(image, (x, int(0.16 * _SIDE)), leaf, 20, 0, 360, (80, 140, 80), -1, cv2.LINE_AA)
        cv2.line(image, (x + 14, int(0.40 * _SIDE)), (x + 14, int(0.70 * _SIDE)), (150, 150, 150), 2)
    return image


def _tube(rng: np.random.Generator) -> Image:
    image = np.full((_SIDE, _SIDE, 3), (150, 165, 160), np.uint8)
    turn = rng.uniform(0, 1)
    for i in range(8):  # lines along the axis show how the section turns oval
        x = int((i + turn) * _SIDE / 8)
        cv2.line(image, (x, 0), (x, _SIDE), (70, 80, 75), 3)
    for j in range(6):  # rings show how it bends
        y = int((j + 0.5) * _SIDE / 6)
        cv2.line(image, (0, y), (_SIDE, y), (215, 220, 215), 5)
    return image


def _ball(rng: np.random.Generator) -> Image:
    image = np.full((_SIDE, _SIDE, 3), (60, 130, 200), np.uint8)
    bands = _clouds(rng, 14)
    image[np.abs(bands) < 0.35] = (200, 220, 235)
    image[bands > 1.1] = (60, 60, 70)
    return image


_OF_OBJECTS = {"sponge.png": _sponge, "cup.png": _cup, "tube.png": _tube, "ball.png": _ball}
