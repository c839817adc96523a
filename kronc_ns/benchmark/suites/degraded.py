"""What spoils photos: blur, no texture, a background that stands still, people who walk by."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from kronc_ns.refine.pictures import Picture, Pictures

_PEOPLE = 4
_SHARES = {"none": 0.2, "blur": 0.15, "plain": 0.1, "still": 0.25, "people": 0.15, "focal": 0.15}


@dataclass(frozen=True)
class Trouble:
    """What is done to all photos of a capture."""

    white: bool = False
    """White around the vehicle."""
    blur_px: float = 0.0
    plain: bool = False
    """No texture: every photo is smoothed until only large areas are left."""
    still: bool = False
    """The background is the first photo's: the car turned, the camera did not."""
    people: bool = False
    """People walk through, somewhere else in every photo."""
    no_masks: bool = False
    focal_held: bool = False
    """A wrong focal length is held fixed."""
    seed: int = 0


def draw_trouble(rng: np.random.Generator) -> Trouble:
    """Some trouble, or none."""
    kind = rng.choice(list(_SHARES), p=list(_SHARES.values()))
    return Trouble(
        blur_px=float(rng.uniform(1.5, 6.0)) if kind == "blur" else 0.0,
        plain=kind == "plain",
        still=kind == "still",
        people=kind == "people",
        no_masks=bool(rng.random() < 0.4),
        focal_held=kind == "focal",
        seed=int(rng.integers(2**31)),
    )


def degraded(pictures: Pictures, trouble: Trouble, views: int) -> Pictures:
    """The pictures of a capture with so many views, spoilt; always alike."""
    behind = _without_vehicle(pictures(0)) if trouble.still else None
    people = np.random.default_rng(trouble.seed).uniform(0, 255, (_PEOPLE, 60, 20, 3))
    people = [cv2.GaussianBlur(one.astype(np.float32), (0, 0), 1.0) for one in people]

    def read(view: int) -> Picture:
        picture = pictures(view)
        rgb = picture.rgb
        if behind is not None and picture.vehicle is not None:
            rgb = np.where(picture.vehicle[..., None] > 0, rgb, behind)
        if trouble.white and picture.vehicle is not None:
            rgb = np.where(picture.vehicle[..., None] > 0, rgb, np.uint8(255))
        if trouble.people:
            rgb = _with_people(rgb, people, np.random.default_rng([trouble.seed, view]))
        if trouble.plain:
            rgb = cv2.medianBlur(cv2.GaussianBlur(rgb, (0, 0), 8.0), 15)
        if trouble.blur_px:
            rgb = cv2.GaussianBlur(rgb, (0, 0), trouble.blur_px)
        vehicle = None if trouble.no_masks else picture.vehicle
        return replace(picture, rgb=np.ascontiguousarray(rgb.astype(np.uint8)), vehicle=vehicle)

    return read


def _without_vehicle(picture: Picture) -> np.ndarray:
    """The photo with the vehicle painted over by what is around it."""
    if picture.vehicle is None:
        return picture.rgb
    hole = cv2.dilate(picture.vehicle, np.ones((9, 9), np.uint8))
    return cv2.inpaint(picture.rgb, hole, 3, cv2.INPAINT_TELEA)


def _with_people(rgb: np.ndarray, people: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Upright figures of fixed looks at random places, half as high as the photo at the most."""
    out = rgb.copy()
    height, width = rgb.shape[:2]
    for person in people:
        tall = int(rng.uniform(0.2, 0.5) * height)
        figure = cv2.resize(person, (max(tall // 3, 2), tall))
        x, y = int(rng.integers(0, width - figure.shape[1])), int(rng.integers(0, height - tall))
        out[y : y + tall, x : x + figure.shape[1]] = figure
    return out
