"""`kronc eval`."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from kronc_ns.errors import KroncError


@dataclass(kw_only=True)
class Eval:
    """Compare poses with a reference (--poses, --reference), or a trained run with its test views (--nvs)."""

    poses: Path | None = None
    """transforms.json with the poses to judge, after similarity alignment."""
    reference: Path | None = None
    """transforms.json (or reference.json) with the true or trusted poses."""
    nvs: Path | None = None
    """config.yml of a trained run of any nerfstudio method. PSNR, SSIM and LPIPS are given of the full frame and,
    where masks or alpha tell it, of the vehicle alone."""
    pictures: Path | None = None
    """With --nvs: new folder for a picture of every test view, rendered | truth | error (brightest from 0.25 on)."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Print the errors."""
        if self.nvs is not None:
            if self.poses is not None or self.reference is not None:
                raise KroncError("--nvs with --poses or --reference: expected either a trained run or poses")
            return self._views(self.nvs)
        if self.poses is None or self.reference is None:
            raise KroncError("expected --poses and --reference, or --nvs with the config.yml of a trained run")
        if self.pictures is not None:
            raise KroncError(f"--pictures {self.pictures} without --nvs: only test views can be drawn")
        return self._poses(self.poses, self.reference)

    def _poses(self, poses: Path, reference: Path) -> int:
        from kronc_ns.files.transforms import read_poses
        from kronc_ns.metrics.poses import evaluate_poses

        errors = evaluate_poses(read_poses(poses), read_poses(reference)).as_dict()
        if self.json:
            print(json.dumps(errors))
            return 0
        from rich.console import Console
        from rich.table import Table

        table = Table("error", "mean", "median", "max", title=f"{errors['registered']} of {errors['views']} views")
        for label, key in (("rotation (deg)", "rotation_deg"), ("camera centre (reference's unit)", "translation")):
            table.add_row(label, *(f"{errors[key][which]:.4f}" for which in ("mean", "median", "max")))
        Console().print(table)
        print("  ".join(f"{key} {errors[key]:.4f}" for key in errors if key.startswith("auc")))
        return 0

    def _views(self, config: Path) -> int:
        from rich.console import Console

        from kronc_ns.commands.console import metrics_table, progress_bar
        from kronc_ns.plugin.compatibility import lpips_remedy
        from kronc_ns.plugin.evaluate import evaluate_run

        with progress_bar("rendering") as progress:
            result = evaluate_run(config, self.pictures, progress)
        if result["full"]["lpips"] is None:
            print(f"LPIPS is not available: {lpips_remedy()}", file=sys.stderr)
        if self.json:
            print(json.dumps(result, allow_nan=False))
            return 0
        Console().print(metrics_table(result))
        return 0
