"""nerfstudio's commands as a user runs them, and the data sets that they are run on."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from kronc_ns.benchmark.commands import Commands
from kronc_ns.capture.images import load_image, write_downscales
from kronc_ns.capture.masks import downscale_mask


def add_half_size(data: Path) -> None:
    """Write images_2 and masks_2 of a scene folder, as `ns-process-data kronc` does."""
    for image in sorted((data / "images").iterdir()):
        write_downscales(load_image(image), image, (2,))
    (data / "masks_2").mkdir(exist_ok=True)
    for mask in sorted((data / "masks").iterdir()):
        half = downscale_mask(np.asarray(load_image(mask)), 2)
        Image.fromarray(half).save(data / "masks_2" / mask.name)


def evaluate(config: Path, renders: Path | None = None) -> dict[str, Any]:
    """`ns-eval` of a run: mean PSNR, SSIM and LPIPS (nan where its weights are missing) over the test views."""
    output = config.parent / "eval.json"
    images = ["--render-output-path", str(renders)] if renders is not None else []
    run("ns-eval", "--load-config", str(config), "--output-path", str(output), *images)
    return json.loads(output.read_text())["results"]


def run(command: str, *arguments: str) -> str:
    """Run one of nerfstudio's commands of this environment; its output, or an error that ends with it."""
    return Commands().run(command, *arguments)
