"""`kronc export --format ply`: cameras and keypoints as a point cloud."""

import json

import numpy as np
import pytest
import trimesh

from kronc_ns.commands.export import write_ply
from kronc_ns.errors import KroncError
from kronc_ns.files.record import solved_points
from kronc_ns.files.transforms import read_poses


def test_ply_holds_camera_centres_and_keypoints(solved_lap_folder, tmp_path):
    count = write_ply(tmp_path / "new" / "cameras.ply", solved_lap_folder)
    cloud = trimesh.load(tmp_path / "new" / "cameras.ply")
    centres = np.stack(list(read_poses(solved_lap_folder / "transforms.json").values()))[..., 3]
    known = solved_points(solved_lap_folder)
    assert count == len(cloud.vertices) == len(centres) + len(known)
    np.testing.assert_allclose(cloud.vertices, np.concatenate([centres, known]), atol=1e-5)
    blue, red = np.split(cloud.colors, [len(centres)])
    assert (blue[:, 2] > blue[:, 0]).all()
    assert (red[:, 0] > red[:, 2]).all()


def test_without_any_pose_there_is_nothing_to_export(walk_folder, tmp_path):
    (walk_folder / "kronc.json").write_text(json.dumps({"points": []}))
    with pytest.raises(KroncError, match=r"transforms\.json: no view has a pose, there is nothing to export"):
        write_ply(tmp_path / "a.ply", walk_folder)
    assert not (tmp_path / "a.ply").exists()
