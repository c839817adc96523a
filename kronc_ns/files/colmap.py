"""COLMAP models of solved folders."""

from pathlib import Path

import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.files.cloud import FILE
from kronc_ns.files.record import KEYPOINT_COLOUR, read_solution, solved_points
from kronc_ns.files.transforms import cameras_and_frames, check_file_names, read_poses, read_transforms
from kronc_ns.geometry.poses import invert
from kronc_ns.solution import Cloud


def write_colmap(folder: Path, solved: Path) -> int:
    """Write the COLMAP model (binary) of a solved folder: cameras, images with poses, keypoints and features as 3D
    points, the latter with their tracks.

    Returns the number of images. Positions, axes and the half-pixel convention are COLMAP's.
    """
    import zlib  # noqa: F401 - pycolmap >= 4.1 aborts the process where zlib comes after it

    import pycolmap

    transforms = solved / "transforms.json"
    cameras, frames = cameras_and_frames(read_transforms(transforms), transforms)
    check_file_names([frame["file_path"] for frame in frames], transforms)
    poses = read_poses(transforms)
    lacking = [frame["file_path"] for frame in frames if frame["file_path"] not in poses]
    if lacking:
        raise KroncError(
            f"{transforms}: {lacking[0]} has no transform_matrix: expected one in every frame: solve again"
        )
    names, cloud = _features(solved)
    model = pycolmap.Reconstruction()
    numbers = {camera: number for number, camera in enumerate(dict.fromkeys(cameras), start=1)}
    for camera, number in numbers.items():
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=number,
                model="OPENCV",
                width=camera.width,
                height=camera.height,
                params=[camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
            )
        )
    sightings = 0 if cloud is None else len(cloud.view)
    image_of, place = np.zeros(sightings, int), np.zeros(sightings, int)  # of each sighting, once its image is there
    for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True), start=1):
        w2c = invert(poses[frame["file_path"]])
        image = pycolmap.Image(name=Path(frame["file_path"]).name, camera_id=numbers[camera], image_id=number)
        if cloud is not None and frame["file_path"] in names:
            own = np.flatnonzero(cloud.view == names[frame["file_path"]])
            image.points2D = [pycolmap.Point2D(pixel) for pixel in cloud.pixel[own]]  # pyright: ignore[reportAttributeAccessIssue]
            place[own], image_of[own] = np.arange(len(own)), number
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(w2c))
    for point in solved_points(solved):
        model.add_point3D(point, pycolmap.Track(), KEYPOINT_COLOUR)
    if cloud is not None:
        for k, (point, colour) in enumerate(zip(cloud.points, cloud.colours, strict=True)):
            seen = range(cloud.first[k], cloud.first[k + 1])
            elements = [pycolmap.TrackElement(int(image_of[o]), int(place[o])) for o in seen if image_of[o]]
            model.add_point3D(point, pycolmap.Track(elements), colour)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        model.write_binary(str(folder))
    except (OSError, ValueError) as error:  # ValueError: pycolmap could not open or write a file
        raise KroncError(f"{folder} cannot be written: {getattr(error, 'strerror', None) or error}") from None
    return len(frames)


def _features(solved: Path) -> tuple[dict[str, int], Cloud | None]:
    """The number of each view of a solution, and the cloud that its sightings are of."""
    if not (solved / FILE).exists():
        return {}, None
    solution = read_solution(solved)[1]
    return {name: number for number, name in enumerate(solution.names)}, solution.cloud
