"""The cars to train on: labelled meshes in many proportions, and procedural ones."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.training.body import Body
from kronc_ns.training.decals import painted
from kronc_ns.training.deformation import Proportions, deform, refined
from kronc_ns.training.labelling import read_labels
from kronc_ns.training.meshes import load_textured_mesh
from kronc_ns.training.procedural import draw_procedural

LABELS = Path(__file__).parent / "labels"
WITH_KEYPOINTS = ("tesla_model3", "md_280zx", "md_beetle")
"""Cars of the other folder that may be used: CC-BY, keypoints beside them."""
KEPT_OUT = ("chrono_sedan", "ghia", "md_beetle")
"""Cars that are not trained on, so that the confidence can be measured on bodies the network has never seen."""
_TWO_DOORS = ("md_280zx", "md_beetle")
_REAR_DOORS = [16, 17, 18, 19, 38, 39, 40, 41]
_PROCEDURAL = 0.45  # share of drawn bodies
# modern cars are what is photographed most: shares of the meshes, others 1
_SHARES = {
    "tesla_model3": 2.0, "jme_hatchback": 2.0, "chrono_audi": 1.6, "gazebo_prius": 1.6, "gazebo_hatchback": 1.6,
    "gazebo_suv": 1.2, "chrono_jeep": 1.2, "chrono_patrol": 1.2, "md_280zx": 1.6, "m3_gt3": 1.4, "chrono_uaz_bus": 0.6,
    "chrono_vw_bus": 0.6, "chrono_uaz469": 0.6,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Model:
    """A mesh with its keypoints, and what has to be painted on it."""

    body: Body
    draw: tuple[str, ...]


def load_garage(cars_train: Path, cars: Path | None, kept_out: bool = False) -> list[Model]:
    """The labelled meshes: ``cars_train/NAME/car.glb`` with our labels, and cars that bring ``keypoints3d.json``.

    Those of `KEPT_OUT` alone, or all others.
    """
    models = []
    for labels in sorted(LABELS.glob("*.json")):
        file = cars_train / labels.stem / "car.glb"
        if not file.is_file() or (labels.stem in KEPT_OUT) != kept_out:
            continue
        mesh = refined(load_textured_mesh(file))
        points = read_labels(labels, mesh.geometry()).points
        draw = json.loads(labels.read_text()).get("draw", [])
        models.append(Model(Body(labels.stem, mesh, points), tuple(draw)))
    if cars is not None:
        named = [name for name in WITH_KEYPOINTS if (name in KEPT_OUT) == kept_out]
        models += [Model(labelled_body(cars / name), ()) for name in named if (cars / name).is_dir()]
    if not models:
        raise KroncError(f"{cars_train} holds none of the labelled cars: expected NAME/car.glb")
    return models


def labelled_body(folder: Path) -> Body:
    """``car.glb`` with ``keypoints3d.json`` beside it."""
    points = np.array(json.loads((folder / "keypoints3d.json").read_text())["keypoints"], dtype=np.float64)
    if folder.name in _TWO_DOORS:
        points[_REAR_DOORS] = np.nan
    return Body(folder.name, refined(load_textured_mesh(folder / "car.glb")), points)


def draw_body(rng: np.random.Generator, garage: Sequence[Model], procedural: float = _PROCEDURAL) -> Body:
    """A car of the garage in other proportions, or (a share of ``procedural``) a procedural one; painted."""
    if rng.uniform() < procedural:
        return draw_procedural(rng)
    shares = np.array([_SHARES.get(model.body.name, 1.0) for model in garage])
    model = garage[int(rng.choice(len(garage), p=shares / shares.sum()))]
    shaped = model.body if rng.uniform() < 0.1 else deform(model.body, Proportions.draw(rng))
    return painted(shaped, model.draw, rng)
