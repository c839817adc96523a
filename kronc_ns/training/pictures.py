"""The training pictures: rendered in shards, each from a seed of its own, so that many can work and any can stop."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from kronc_ns.training.appearance import draw_look
from kronc_ns.training.bodies import Model, draw_body
from kronc_ns.training.cameras import draw_shot
from kronc_ns.training.lighting import Panorama, draw_surroundings
from kronc_ns.training.rendering import render
from kronc_ns.training.shards import Picture, write_shard
from kronc_ns.training.stage import Stage

_BODIES, _VIEWS = 8, 8  # in a shard
_LEAST_VISIBLE = 3  # keypoints: pictures of less teach nothing


def render_shards(
    garage: Sequence[Model], panoramas: Sequence[Panorama], output: Path, numbers: Sequence[int], seed: int
) -> Iterator[Path]:
    """Render the shards with these numbers that are not there yet; yields each as it is written."""
    output.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        file = output / f"{number:05d}.npz"
        if not file.exists():
            write_shard(file, draw_pictures(garage, panoramas, np.random.default_rng([seed, number])))
            yield file


def draw_pictures(
    garage: Sequence[Model], panoramas: Sequence[Panorama], rng: np.random.Generator, bodies: int = _BODIES
) -> list[Picture]:
    """Some bodies from many sides, each picture with its own paint and surroundings."""
    pictures = []
    for _ in range(bodies):
        stage = Stage(draw_body(rng, garage), rng)
        for _ in range(_VIEWS):
            shot, around = draw_shot(rng, stage.bounds), draw_surroundings(rng, panoramas)
            picture = render(stage, draw_look(rng, stage.body.mesh), around, shot)
            if (picture.keypoints[:, 2] == 1).sum() >= _LEAST_VISIBLE:
                pictures.append(picture)
    return pictures
