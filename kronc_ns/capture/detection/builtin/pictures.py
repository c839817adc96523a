"""Image files as the network sees them: upright, at most `MAX_LONG_SIDE`, with the way back to the stored pixels."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import ExifTags, ImageOps

from kronc_ns.capture.detection.pixels import MAX_LONG_SIDE, on_white, shrink
from kronc_ns.capture.images import load_small, upright_size

_TURNS = {  # EXIF orientation: rows (x, y, 1) that make shares of the stored sides from upright ones
    1: [[1, 0, 0], [0, 1, 0]],
    2: [[-1, 0, 1], [0, 1, 0]],
    3: [[-1, 0, 1], [0, -1, 1]],
    4: [[1, 0, 0], [0, -1, 1]],
    5: [[0, 1, 0], [1, 0, 0]],
    6: [[0, 1, 0], [-1, 0, 1]],
    7: [[0, -1, 1], [-1, 0, 1]],
    8: [[0, -1, 1], [1, 0, 0]],
}


@dataclass(frozen=True, eq=False)
class Upright:
    """An image turned as its EXIF says, and scaled down."""

    rgb: UInt8[np.ndarray, "h w 3"]
    stored_size: tuple[int, int]
    """(width, height) of the file's own pixels."""
    orientation: int
    """As EXIF counts, 1 to 8."""

    @property
    def px_per_px(self) -> float:
        """Stored pixels per pixel here."""
        return max(self.stored_size) / max(self.rgb.shape[:2])

    def to_stored(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels here as pixels of the file."""
        shares = uv / np.array(self.rgb.shape[1::-1])
        turn = np.array(_TURNS[self.orientation], dtype=np.float64)
        return (shares @ turn[:, :2].T + turn[:, 2]) * np.array(self.stored_size)

    def box_to_stored(self, box: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
        """Left, top, right, bottom here as those in the file."""
        corners = self.to_stored(box.reshape(2, 2))
        return np.concatenate([corners.min(0), corners.max(0)])

    def from_stored(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """The inverse of `to_stored`."""
        turn = np.array(_TURNS[self.orientation], dtype=np.float64)
        shares = (uv / np.array(self.stored_size) - turn[:, 2]) @ turn[:, :2]
        return shares * np.array(self.rgb.shape[1::-1])


def read_upright(path: Path) -> Upright:
    """Read an image of any usual kind; where it is transparent, white shines through."""
    stored_size = upright_size(path, orient=False)
    image = load_small(path, MAX_LONG_SIDE)
    orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
    rgb, _ = shrink(np.asarray(on_white(ImageOps.exif_transpose(image))), MAX_LONG_SIDE)
    return Upright(rgb, stored_size, orientation if orientation in _TURNS else 1)
