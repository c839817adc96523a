"""Keypoint schemas: names, mirror pairs and skeleton, above all the 66 points of ApolloCar3D."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError


@dataclass(frozen=True)
class KeypointSchema:
    """J named points of an object class; ``flip[j]`` is the index of j's mirror partner (itself if it has none)."""

    name: str
    keypoints: tuple[str, ...]
    flip: tuple[int, ...]
    left: tuple[int, ...] = ()
    """Indices on the object's own left side, where known."""
    wheels: tuple[int, ...] = ()
    """Wheel centres as (left front, right front, left rear, right rear), where the schema has them."""
    skeleton: tuple[tuple[int, int], ...] = ()
    """Pairs of points to join by a line in pictures."""

    def __post_init__(self) -> None:
        count = len(self.keypoints)
        if count < 4:
            raise KroncError(f"keypoint schema {self.name!r} has {count} points: expected at least 4")
        if sorted(self.flip) != list(range(count)) or any(self.flip[f] != i for i, f in enumerate(self.flip)):
            raise KroncError(
                f"keypoint schema {self.name!r}: flip must pair each of the {count} indices with its mirror partner, "
                "and back"
            )

    def __len__(self) -> int:
        return len(self.keypoints)

    def mirrored(self, keypoints: Float[np.ndarray, "*n j k"]) -> Float[np.ndarray, "*n j k"]:
        """Detections with left and right exchanged."""
        return keypoints[..., list(self.flip), :]

    @property
    def mirror_pairs(self) -> tuple[tuple[int, int], ...]:
        """(left, right) indices of each mirrored pair; empty where the sides are not known."""
        return tuple((i, self.flip[i]) for i in self.left)


_NAMES = (
    "top_left_c_left_front_car_light",
    "bottom_left_c_left_front_car_light",
    "top_right_c_left_front_car_light",
    "bottom_right_c_left_front_car_light",
    "top_right_c_left_front_fog_light",
    "bottom_right_c_left_front_fog_light",
    "front_section_left_front_wheel",
    "center_left_front_wheel",
    "top_right_c_front_glass",
    "top_left_c_left_front_door",
    "bottom_left_c_left_front_door",
    "top_right_c_left_front_door",
    "middle_c_left_front_door",
    "front_c_car_handle_left_front_door",
    "rear_c_car_handle_left_front_door",
    "bottom_right_c_left_front_door",
    "top_right_c_left_rear_door",
    "front_c_car_handle_left_rear_door",
    "rear_c_car_handle_left_rear_door",
    "bottom_right_c_left_rear_door",
    "center_left_rear_wheel",
    "rear_section_left_rear_wheel",
    "top_left_c_left_rear_car_light",
    "bottom_left_c_left_rear_car_light",
    "top_left_c_rear_glass",
    "top_right_c_left_rear_car_light",
    "bottom_right_c_left_rear_car_light",
    "bottom_left_c_trunk",
    "Left_c_rear_bumper",
    "Right_c_rear_bumper",
    "bottom_right_c_trunk",
    "bottom_left_c_right_rear_car_light",
    "top_left_c_right_rear_car_light",
    "top_right_c_rear_glass",
    "bottom_right_c_right_rear_car_light",
    "top_right_c_right_rear_car_light",
    "rear_section_right_rear_wheel",
    "center_right_rear_wheel",
    "bottom_left_c_right_rear_car_door",
    "rear_c_car_handle_right_rear_car_door",
    "front_c_car_handle_right_rear_car_door",
    "top_left_c_right_rear_car_door",
    "bottom_left_c_right_front_car_door",
    "rear_c_car_handle_right_front_car_door",
    "front_c_car_handle_right_front_car_door",
    "middle_c_right_front_car_door",
    "top_left_c_right_front_car_door",
    "bottom_right_c_right_front_car_door",
    "top_right_c_right_front_car_door",
    "top_left_c_front_glass",
    "center_right_front_wheel",
    "front_section_right_front_wheel",
    "bottom_left_c_right_fog_light",
    "top_left_c_right_fog_light",
    "bottom_left_c_right_front_car_light",
    "top_left_c_right_front_car_light",
    "bottom_right_c_right_front_car_light",
    "top_right_c_right_front_car_light",
    "top_right_c_front_lplate",
    "top_left_c_front_lplate",
    "bottom_right_c_front_lplate",
    "bottom_left_c_front_lplate",
    "top_left_c_rear_lplate",
    "top_right_c_rear_lplate",
    "bottom_right_c_rear_lplate",
    "bottom_left_c_rear_lplate",
)

_LEFT_RIGHT = (
    (0, 57), (1, 56), (2, 55), (3, 54), (4, 53), (5, 52), (6, 51), (7, 50), (8, 49), (9, 48), (10, 47), (11, 46),
    (12, 45), (13, 44), (14, 43), (15, 42), (16, 41), (17, 40), (18, 39), (19, 38), (20, 37), (21, 36), (22, 35),
    (23, 34), (24, 33), (25, 32), (26, 31), (27, 30), (28, 29), (59, 58), (61, 60), (62, 63), (65, 64),
)  # fmt: skip

_SKELETON_LEFT = (
    (0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (4, 3), (5, 6), (6, 7), (7, 10), (8, 9), (9, 10), (9, 12), (8, 11),
    (11, 12), (12, 15), (10, 15), (13, 14), (11, 16), (15, 19), (16, 18), (17, 18), (16, 24), (19, 20), (20, 21),
    (22, 23), (22, 25), (23, 26), (25, 26), (22, 24), (26, 27), (21, 28), (62, 65),
)  # fmt: skip
_SKELETON_ACROSS = (
    (0, 57), (8, 49), (24, 33), (28, 29), (27, 30), (58, 59), (60, 61), (58, 60), (59, 61), (62, 63), (64, 65),
    (63, 64),
)  # fmt: skip

_FLIP = tuple(dict([*_LEFT_RIGHT, *((right, left) for left, right in _LEFT_RIGHT)])[i] for i in range(len(_NAMES)))

APOLLOCAR3D_66 = KeypointSchema(
    name="apollocar3d-66",
    keypoints=_NAMES,
    flip=_FLIP,
    left=tuple(left for left, _ in _LEFT_RIGHT),
    wheels=(7, 50, 20, 37),
    skeleton=tuple(
        sorted(
            {(min(a, b), max(a, b)) for a, b in (*_SKELETON_LEFT, *_SKELETON_ACROSS)}
            | {(min(_FLIP[a], _FLIP[b]), max(_FLIP[a], _FLIP[b])) for a, b in _SKELETON_LEFT}
        )
    ),
)
"""The 66 car keypoints of ApolloCar3D (Song et al., CVPR 2019), in its order. "left" is the car's own left.

Corner words in the names are partly the viewer's: trust ``left`` and ``flip``.
"""

_OPENPIFPAF_24 = (
    49, 8, 57, 0, 52, 5, 11, 7, 20, 23, 24, 33, 25, 32, 28, 29, 46, 34, 37, 50, 65, 64, 9, 48,
)  # fmt: skip


def _part(name: str, whole: KeypointSchema, indices: tuple[int, ...]) -> KeypointSchema:
    """The points ``indices`` of a schema, in that order; they contain both of each pair."""
    new = {old: i for i, old in enumerate(indices)}
    return KeypointSchema(
        name=name,
        keypoints=tuple(whole.keypoints[old] for old in indices),
        flip=tuple(new[whole.flip[old]] for old in indices),
        left=tuple(new[old] for old in whole.left if old in new),
        wheels=tuple(new[old] for old in whole.wheels if old in new),
        skeleton=tuple((new[a], new[b]) for a, b in whole.skeleton if a in new and b in new),
    )


APOLLOCAR3D_24 = _part("apollocar3d-24", APOLLOCAR3D_66, _OPENPIFPAF_24)
"""The 24 of them that OpenPifPaf's smaller car models find, in its order."""

KNOWN_SCHEMAS = {schema.name: schema for schema in (APOLLOCAR3D_66, APOLLOCAR3D_24)}
"""Schemas that files may call by name alone."""


def schema_of_count(count: int) -> KeypointSchema:
    """The known schema of so many points; otherwise points without names, of which none is another's mirror image."""
    for schema in KNOWN_SCHEMAS.values():
        if len(schema) == count:
            return schema
    return KeypointSchema(f"points-{count}", tuple(f"point_{j}" for j in range(count)), tuple(range(count)))
