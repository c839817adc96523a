"""Bundle adjustment by pycolmap (Ceres): from the truth the yardstick of the tables, from a noisy start a peer."""

import math
import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import rays
from kronc_ns.geometry.poses import invert
from kronc_ns.geometry.triangulation import triangulate
from kronc_ns.scene import Scene

Loss = Literal["trivial", "cauchy"]
LinearSolver = Literal["auto", "DENSE_SCHUR", "SPARSE_NORMAL_CHOLESKY", "ITERATIVE_SCHUR"]
_LOSS_SCALE_PX = 2.0  # residuals well above this lose weight (Cauchy)
_LEAST_POINTS = 4  # a view with fewer keypoints has no pose of its own


@dataclass(frozen=True)
class Adjustment:
    """Where bundle adjustment ended."""

    c2w: Float[np.ndarray, "n 3 4"]
    """Poses; NaN where a view has too few keypoints to have one."""
    points: Float[np.ndarray, "j 3"]
    """Keypoints; NaN where fewer than two views see one."""
    focal_px: float
    seconds: float
    """Time of the adjustment alone, without building pycolmap's model of the scene."""
    converged: bool


def bundle_adjustment(
    scene: Scene,
    c2w: Float[np.ndarray, "n 3 4"],
    points: Float[np.ndarray, "j 3"] | None = None,
    used: Bool[np.ndarray, "n j"] | None = None,
    loss: Loss = "trivial",
    refine_focal: bool = False,
    function_tolerance: float = 0.0,
    linear_solver: LinearSolver = "auto",
) -> Adjustment:
    """Minimise the reprojection error of the detections ``used`` from poses ``c2w`` and ``points`` (or triangulated).

    Free gauge, one focal length, everything else as pycolmap has it by default (Levenberg-Marquardt, a gradient
    tolerance of 1e-4, at most 100 steps); Ceres' own default for ``function_tolerance`` is 1e-6.
    """
    pycolmap = load_pycolmap()
    counted = scene.seen if used is None else used & scene.seen
    counted = counted & (counted.sum(1, keepdims=True) >= _LEAST_POINTS)
    counted = counted & (counted.sum(0) >= 2)
    if points is None:
        points = triangulate(c2w, rays(scene.uv, scene.camera), counted.astype(np.float64))
    model = _model(scene, c2w, points, counted)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = refine_focal
    options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType(loss.upper())
    options.ceres.loss_function_scale = _LOSS_SCALE_PX
    options.ceres.solver_options.function_tolerance = function_tolerance
    if linear_solver != "auto":  # COLMAP chooses by the number of views
        options.ceres.auto_select_solver_type = False
        solver = options.ceres.solver_options
        solver.linear_solver_type = type(solver.linear_solver_type)(linear_solver)
    config = pycolmap.BundleAdjustmentConfig()  # pycolmap.bundle_adjustment would fix two cameras as the gauge
    for view in model.images:
        config.add_image(view)
    start = time.perf_counter()
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    seconds = time.perf_counter() - start

    posed, known = counted.any(1), counted.any(0)
    adjusted = np.full(c2w.shape, math.nan)
    adjusted[posed] = invert(
        np.stack([model.images[i + 1].cam_from_world().matrix() for i in np.flatnonzero(posed).tolist()])
    )
    world = np.full(points.shape, math.nan)
    world[known] = np.stack([model.points3D[j + 1].xyz for j in np.flatnonzero(known).tolist()])
    converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
    return Adjustment(adjusted, world, float(model.cameras[1].params[0]), seconds, converged)


def load_pycolmap() -> Any:
    """The module, silent but for errors: a start far off makes Ceres warn of every singular step it damps."""
    import zlib  # noqa: F401 - pycolmap >= 4.1 aborts the process where zlib comes after it

    import pycolmap

    if not hasattr(pycolmap.BundleAdjustmentOptions(), "ceres"):
        raise KroncError(f"pycolmap {pycolmap.__version__} is too old for the benchmark: pip install 'pycolmap>=4.1'")
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    return pycolmap


def _model(
    scene: Scene, c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "j 3"], used: Bool[np.ndarray, "n j"]
) -> Any:
    """pycolmap's model: image i + 1 has all J keypoints, those that are used observe point j + 1."""
    pycolmap = load_pycolmap()
    camera = scene.camera
    model = pycolmap.Reconstruction()
    kind, focal = "SIMPLE_PINHOLE", [camera.fx]  # refined as one
    if camera.fx != camera.fy:
        kind, focal = "PINHOLE", [camera.fx, camera.fy]
    intrinsics = [*focal, camera.cx, camera.cy]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=kind, width=camera.width, height=camera.height, params=intrinsics)
    )
    w2c = invert(c2w)
    for i in np.flatnonzero(used.any(1)).tolist():
        image = pycolmap.Image(name=scene.names[i], keypoints=scene.uv[i], camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(w2c[i]))
    for j in np.flatnonzero(used.any(0)).tolist():
        model.add_point3D_with_id(j + 1, pycolmap.Point3D(xyz=points[j]))
    for i, j in np.argwhere(used).tolist():
        model.add_observation(j + 1, pycolmap.TrackElement(i + 1, j))
    return model
