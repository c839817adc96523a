"""nerfstudio's commands as a user runs them, and the data sets that they are run on."""

import io
import json
import os
import sys
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from PIL import Image

from kronc_ns.benchmark.commands import Commands
from kronc_ns.capture.images import load_image, write_downscales
from kronc_ns.capture.masks import downscale_mask
from kronc_ns.errors import KroncError

_ENTRY_POINTS = {
    "kronc": ("kronc_ns.commands.main", "main"),
    "ns-train": ("nerfstudio.scripts.train", "entrypoint"),
    "ns-eval": ("nerfstudio.scripts.eval", "entrypoint"),
    "ns-render": ("nerfstudio.scripts.render", "entrypoint"),
    "ns-export": ("nerfstudio.scripts.exporter", "entrypoint"),
}


class InProcess(Commands):
    """Calls the commands' entry points here: a process of their own would import nerfstudio anew, for seconds."""

    def run(self, command: str, *arguments: str) -> str:
        """What a command prints on stdout; `KroncError` where its status is not 0."""
        module, function = _ENTRY_POINTS[command]
        entry_point, output = getattr(import_module(module), function), io.StringIO()
        forget_writers()
        with (
            mock.patch.object(sys, "argv", [command, *arguments]),
            mock.patch.dict(os.environ, self._environment),
            redirect_stdout(output),
        ):
            try:
                entry_point()
            except SystemExit as ended:
                if ended.code:
                    raise KroncError(f"{command} ended with status {ended.code}: {output.getvalue()}") from None
        return output.getvalue()


def forget_writers() -> None:
    """Empty nerfstudio's list of event writers, which outlives a training: all of them would log the next one, too."""
    if "nerfstudio.utils.writer" in sys.modules:
        sys.modules["nerfstudio.utils.writer"].EVENT_WRITERS.clear()


def add_half_size(data: Path) -> None:
    """Write images_2 and masks_2 of a scene folder, as `ns-process-data kronc` does."""
    for image in sorted((data / "images").iterdir()):
        write_downscales(load_image(image), image, (2,))
    (data / "masks_2").mkdir(exist_ok=True)
    for mask in sorted((data / "masks").iterdir()):
        half = downscale_mask(np.asarray(load_image(mask)), 2)
        Image.fromarray(half).save(data / "masks_2" / mask.name)


def evaluate(config: Path, renders: Path | None = None, commands: Commands | None = None) -> dict[str, Any]:
    """`ns-eval` of a run: mean PSNR, SSIM and LPIPS (nan where its weights are missing) over the test views."""
    output = config.parent / "eval.json"
    images = ["--render-output-path", str(renders)] if renders is not None else []
    (commands or InProcess()).run("ns-eval", "--load-config", str(config), "--output-path", str(output), *images)
    return json.loads(output.read_text())["results"]
