"""`kronc synth`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from kronc_ns.errors import KroncError


@dataclass(kw_only=True)
class Synth:
    """Make a synthetic capture with exact ground truth: keypoints only, or rendered (--render)."""

    output_dir: Path
    """New or empty folder for the scene; the truth goes to reference.json."""
    preset: Literal["carpatch", "walk"] = "walk"
    """carpatch: cameras on a hemisphere, 400x400; walk: a handheld lap, 480x270."""
    views: int = 100
    """Number of images."""
    width: int | None = None
    """Image width in pixels (default: the preset's); the height follows."""
    noise_px: float = 0.0
    """Standard deviation of the keypoint noise per axis."""
    outliers: float = 0.0
    """Share of keypoints that lie anywhere on the car's box."""
    missing: float = 0.0
    """Share of visible keypoints that are not found."""
    pose_noise_deg: float = 0.0
    """Rotation noise of the poses written to transforms.json (with --pose-noise-m; 0 and 0: no poses)."""
    pose_noise_m: float = 0.0
    """Translation noise of the poses written to transforms.json."""
    render: bool = False
    """Draw images, masks and depth maps."""
    renderer: Literal["builtin", "blender"] = "builtin"
    """builtin: a quick ray caster of the procedural car; blender: path-traced, of that car or any --mesh
    (pip install 'kronc-ns[blender]', Python 3.11)."""
    mesh: Path | None = None
    """A car of your own instead of the procedural one: .glb or .gltf in true size, with its 66 keypoints in
    keypoints3d.json beside it."""
    seed: int = 0
    """Seed of trajectory, detections and pose noise."""

    def run(self) -> int:
        """Make and write the capture."""
        self._check()
        import numpy as np

        from kronc_ns.commands.console import progress_bar
        from kronc_ns.synthetic.folder import write_capture
        from kronc_ns.synthetic.mesh import load_mesh_car
        from kronc_ns.synthetic.scenes import default_camera, make_capture
        from kronc_ns.synthetic.variations import noisy_poses

        camera = default_camera(self.preset, self.width)
        car = load_mesh_car(self.mesh) if self.mesh is not None else None
        capture = make_capture(
            self.preset, self.views, self.seed, self.noise_px, self.missing, self.outliers, camera, car
        )
        start = None
        if self.pose_noise_deg or self.pose_noise_m:
            rng = np.random.default_rng(self.seed)
            start = noisy_poses(capture.c2w, self.pose_noise_deg, self.pose_noise_m, rng)
        ground = self.preset == "walk"
        with progress_bar("rendering" if self.render else "writing") as progress:
            write_capture(
                self.output_dir,
                capture,
                start,
                self.render,
                ground,
                lambda view: progress(view, self.views, None),
                self.renderer,
            )
        mean = float(capture.keypoints[..., 2].sum(1).mean())
        print(f"{self.views} views, {mean:.1f} keypoints a view: {self.output_dir}")
        return 0

    def _check(self) -> None:
        shares = {"--outliers": self.outliers, "--missing": self.missing}
        for name, share in shares.items():
            if not 0 <= share < 1:
                raise KroncError(f"{name} is {share}: expected a share from 0 to below 1")
        noises = {
            "--noise-px": self.noise_px,
            "--pose-noise-deg": self.pose_noise_deg,
            "--pose-noise-m": self.pose_noise_m,
        }
        for name, noise in noises.items():
            if not 0 <= noise < math.inf:
                raise KroncError(f"{name} is {noise}: expected a finite standard deviation, 0 or more")
        if not 0 <= self.seed < 2**63:
            raise KroncError(f"--seed is {self.seed}: expected 0 to 2**63 - 1")
        if self.views < 1 or (self.width is not None and self.width < 16):
            raise KroncError(
                f"--views {self.views} --width {self.width}: expected at least 1 view of at least 16 pixels"
            )
        if self.renderer != "builtin" and not self.render:
            raise KroncError(f"--renderer {self.renderer} without --render: add --render, or nothing is drawn")
