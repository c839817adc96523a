"""COLMAP's mappers, on image features or on semantic keypoints, with the intrinsics known."""

import math
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
from jaxtyping import Float

from kronc_ns.benchmark.peers.ceres import load_pycolmap
from kronc_ns.errors import KroncError
from kronc_ns.geometry.poses import invert
from kronc_ns.scene import Scene

Mapper = Literal["incremental", "global"]
# A view has some 15 to 30 keypoints, where COLMAP expects hundreds of features: with its own minima no pair passes.
_LEAST_INLIERS = 8


def map_images(scene: Scene, folder: Path, mapper: Mapper, masked: bool) -> Float[np.ndarray, "n 3 4"]:
    """Poses from SIFT features (CPU, COLMAP's settings) matched between all pairs; NaN where a view is not placed.

    ``masked`` leaves out features on the background.
    """
    pycolmap = load_pycolmap()
    with TemporaryDirectory(prefix="kronc_colmap_") as scratch:
        database = Path(scratch) / "database.db"
        reader = pycolmap.ImageReaderOptions(camera_model=_model(scene), camera_params=_parameters(scene))
        if masked:
            reader.mask_path = _masks(scene, folder, Path(scratch) / "masks")
        pycolmap.extract_features(
            database,
            folder,
            image_names=list(scene.names),
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            device=pycolmap.Device.cpu,
        )
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
        return _map(scene, database, folder, mapper, Path(scratch), few=False)


def map_keypoints(scene: Scene, mapper: Mapper) -> Float[np.ndarray, "n 3 4"]:
    """Poses from keypoints of the same meaning as matches between all views that see eight or more of the same."""
    pycolmap = load_pycolmap()
    with TemporaryDirectory(prefix="kronc_colmap_") as scratch:
        database = Path(scratch) / "database.db"
        seen = scene.seen
        opened = pycolmap.Database.open(database)
        camera = pycolmap.Camera(
            model=_model(scene),
            width=scene.camera.width,
            height=scene.camera.height,
            params=[float(x) for x in _parameters(scene).split(",")],
            has_prior_focal_length=True,
        )
        camera.camera_id = opened.write_camera(camera)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        opened.write_rig(rig)
        pairs = []
        for i, (name, uv) in enumerate(zip(scene.names, scene.keypoints[..., :2], strict=True)):
            image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=i + 1)
            opened.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=i + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            opened.write_frame(frame, use_frame_id=True)
            opened.write_keypoints(i + 1, uv.astype(np.float32))
            for k in range(i):
                shared = np.flatnonzero(seen[i] & seen[k]).astype(np.uint32)
                if len(shared) >= _LEAST_INLIERS:
                    opened.write_matches(k + 1, i + 1, np.stack([shared, shared], axis=1))
                    pairs.append(f"{scene.names[k]} {name}")
        opened.close()
        listed = Path(scratch) / "pairs.txt"
        listed.write_text("\n".join(pairs))
        options = pycolmap.TwoViewGeometryOptions(min_num_inliers=_LEAST_INLIERS)
        pycolmap.verify_matches(database, listed, options)
        return _map(scene, database, Path(scratch), mapper, Path(scratch), few=True)


def _map(
    scene: Scene, database: Path, images: Path, mapper: Mapper, scratch: Path, few: bool
) -> Float[np.ndarray, "n 3 4"]:
    """Poses of the largest model that the mapper makes of a database; intrinsics stay as they are."""
    pycolmap = load_pycolmap()
    models = scratch / "models"
    models.mkdir(exist_ok=True)
    if mapper == "incremental":
        options = pycolmap.IncrementalPipelineOptions(
            ba_refine_focal_length=False, ba_refine_extra_params=False, extract_colors=False, random_seed=0
        )
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
        if few:
            options.min_num_matches = _LEAST_INLIERS
            options.mapper.init_min_num_inliers = _LEAST_INLIERS
            options.mapper.abs_pose_min_num_inliers = _LEAST_INLIERS
        found = pycolmap.incremental_mapping(database, images, models, options)
    else:
        options = pycolmap.GlobalPipelineOptions(random_seed=0)
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
        if few:
            options.min_num_matches = _LEAST_INLIERS
        found = pycolmap.global_mapping(database, images, models, options)
    c2w = np.full((len(scene), 3, 4), math.nan)
    if found:
        model = max(found.values(), key=lambda one: one.num_reg_images())
        rows = {name: i for i, name in enumerate(scene.names)}
        for image in model.images.values():
            if image.has_pose:
                c2w[rows[image.name]] = invert(image.cam_from_world().matrix())
    return c2w


def _masks(scene: Scene, folder: Path, into: Path) -> Path:
    """Links to the masks under the names that COLMAP looks for: the image's with .png behind it."""
    if scene.masks is None:
        raise KroncError(f"{folder}: no masks (mask_path of the frames), so no features can be kept off the background")
    for image, mask in zip(scene.names, scene.masks, strict=True):
        link = into / PurePosixPath(f"{image}.png")
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to((folder / mask).resolve())
    return into


def _model(scene: Scene) -> str:
    return "OPENCV" if any(scene.camera.distortion) else "PINHOLE"


def _parameters(scene: Scene) -> str:
    camera = scene.camera
    values: Sequence[float] = (camera.fx, camera.fy, camera.cx, camera.cy)
    if any(camera.distortion):
        values = (*values, *camera.distortion)
    return ",".join(map(str, values))
