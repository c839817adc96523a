"""The keypoints of a scene, written as other tools write theirs; each returns what is given to ``--keypoints``."""

import json
from pathlib import Path, PurePosixPath

import numpy as np

from kronc_ns.scene import Scene


def coco_annotations(scene: Scene, folder: Path, names: list[str] | None = None) -> Path:
    """COCO's, whose points are flagged 2 where labelled, at pixel indices."""
    width, height = scene.camera.width, scene.camera.height
    return _json(
        folder / "annotations.json",
        {
            "images": [
                {"id": 100 + i, "file_name": PurePosixPath(name).name, "width": width, "height": height}
                for i, name in enumerate(scene.names)
            ],
            "categories": [
                {"id": 1, "name": "car", "keypoints": list(scene.schema.keypoints) if names is None else names}
            ],
            "annotations": [
                {"id": i, "image_id": 100 + i, "category_id": 1, "keypoints": _flat(rows, 2)}
                for i, rows in enumerate(scene.keypoints)
            ],
        },
    )


def cvat_nameless(scene: Scene, folder: Path) -> Path:
    return coco_annotations(scene, folder, [])


def cvat_numbered(scene: Scene, folder: Path) -> Path:
    """CVAT calls the points of a skeleton by their number unless told otherwise."""
    return coco_annotations(scene, folder, [str(j + 1) for j in range(len(scene.schema))])


def cvat_category_per_point(scene: Scene, folder: Path) -> Path:
    return _json(
        folder / "points.json",
        {
            "images": [{"id": i, "file_name": name} for i, name in enumerate(scene.names)],
            "categories": [
                {"id": j + 1, "name": name, "keypoints": [], "skeleton": []}
                for j, name in reversed(list(enumerate(scene.schema.keypoints)))
            ],
            "annotations": [
                {"image_id": i, "category_id": int(j) + 1, "keypoints": [*(rows[j, :2] - 0.5), 2]}
                for i, rows in enumerate(scene.keypoints)
                for j in np.flatnonzero(rows[:, 2])
            ],
        },
    )


def alphapose(scene: Scene, folder: Path) -> Path:
    """Results by file name."""
    return _results(folder / "alphapose-results.json", scene, [PurePosixPath(name).name for name in scene.names])


def mmpose_results(scene: Scene, folder: Path) -> Path:
    """Results by the number in the file name, as COCO's own images have it."""
    return _results(folder / "results.keypoints.json", scene, [_number(name) for name in scene.names])


def detectron2(scene: Scene, folder: Path) -> Path:
    """Results by the ids of the annotations that the model was run on, which lie beside them."""
    coco_annotations(scene, folder)
    return _results(folder / "coco_instances_results.json", scene, [100 + i for i in range(len(scene))])


def ultralytics_validation(scene: Scene, folder: Path) -> Path:
    """Results by stem."""
    return _results(folder / "predictions.json", scene, [PurePosixPath(name).stem for name in scene.names])


def mmpose_predictions(scene: Scene, folder: Path) -> Path:
    for name, rows in zip(scene.names, scene.keypoints, strict=True):
        instance = {
            "keypoints": (rows[:, :2] - 0.5).tolist(),
            "keypoint_scores": rows[:, 2].tolist(),
            "bbox": [[0, 0, 9, 9]],
            "bbox_score": 0.9,
        }
        _json(folder / "predictions" / f"{PurePosixPath(name).stem}.json", [instance])
    return folder / "predictions"


def ultralytics(scene: Scene, folder: Path, dims: int = 3, behind: str = "") -> Path:
    """Labels of a data set, or of predictions where a confidence and a track are behind."""
    (folder / "labels").mkdir(parents=True)
    for name, rows in zip(scene.names, scene.keypoints, strict=True):
        shares = rows / [scene.camera.width, scene.camera.height, 1]
        words = [f"{value:.9g}" for value in np.where(rows[:, 2:] > 0, shares, 0)[:, :dims].ravel()]
        (folder / "labels" / f"{PurePosixPath(name).stem}.txt").write_text(f"0 .5 .5 .4 .4 {' '.join(words)}{behind}\n")
    return folder


def ultralytics_predictions(scene: Scene, folder: Path) -> Path:
    return ultralytics(scene, folder, behind=" 0.87 3")


def ultralytics_places(scene: Scene, folder: Path) -> Path:
    return ultralytics(scene, folder, dims=2) / "labels"


def label_studio(scene: Scene, folder: Path) -> Path:
    return _json(
        folder / "project-1.json",
        [
            {
                "id": i,
                "data": {"image": f"/data/upload/1/3f2b1c4d-{PurePosixPath(name).name}"},
                "annotations": [{"was_cancelled": False, "result": [{"value": p} for p in _percent(scene, rows)]}],
            }
            for i, (name, rows) in enumerate(zip(scene.names, scene.keypoints, strict=True))
        ],
    )


def label_studio_min(scene: Scene, folder: Path) -> Path:
    return _json(
        folder / "project-1-min.json",
        [
            {"id": i, "image": f"/data/local-files/?d=car/{PurePosixPath(name).name}", "kp": _percent(scene, rows)}
            for i, (name, rows) in enumerate(zip(scene.names, scene.keypoints, strict=True))
        ],
    )


WITH_SCORES = (
    alphapose,
    mmpose_results,
    detectron2,
    ultralytics_validation,
    mmpose_predictions,
    ultralytics,
    ultralytics_predictions,
)
WITHOUT_SCORES = (
    *(coco_annotations, cvat_nameless, cvat_numbered, cvat_category_per_point),
    *(ultralytics_places, label_studio, label_studio_min),
)


def _percent(scene: Scene, rows: np.ndarray) -> list[dict]:
    sides = (scene.camera.width, scene.camera.height)
    return [
        {"x": 100 * u / sides[0], "y": 100 * v / sides[1], "width": 0.4, "keypointlabels": [name]}
        for name, (u, v, c) in zip(scene.schema.keypoints, rows, strict=True)
        if c
    ]


def _results(file: Path, scene: Scene, ids: list) -> Path:
    found = [
        {"image_id": i, "category_id": 1, "keypoints": _flat(rows), "score": 0.9}
        for i, rows in zip(ids, scene.keypoints, strict=True)
    ]
    return _json(file, found)


def _flat(rows: np.ndarray, flag: int | None = None) -> list[float]:
    third = rows[:, 2:] if flag is None else flag * (rows[:, 2:] > 0)
    return np.concatenate([rows[:, :2] - 0.5, third], axis=1).ravel().tolist()


def _number(name: str) -> int:
    return int(PurePosixPath(name).stem.rpartition("_")[2])


def _json(file: Path, content) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))
    return file
