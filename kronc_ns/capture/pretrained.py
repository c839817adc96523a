"""Networks of the transformers package: from a folder, or by their name on the Hugging Face hub."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.errors import KroncError


@dataclass(frozen=True)
class Pretrained:
    """A network that is ready to run."""

    processor: Any
    """Makes its inputs of images."""
    model: Any
    device: torch.device
    name: str
    """Changes with the weights: name and revision on the hub, or the content of the folder."""


def transformers_for(option: str, extra: str) -> Any:
    """The package, or what ``option`` needs it for and the extra that brings it."""
    try:
        import transformers
    except ImportError:
        raise KroncError(
            f"{option} needs transformers, which is not installed: pip install 'kronc-ns[{extra}]'"
        ) from None
    return transformers


def load_pretrained(model_class: Any, weights: Path | None, default: str, option: str) -> Pretrained:
    """A network of one of transformers' classes with its ``weights`` (None: ``default``, downloaded).

    Raises `KroncError` that says what to give as ``option`` where they cannot be loaded.
    """
    from transformers import AutoImageProcessor

    name = str(weights or default)
    try:
        processor = AutoImageProcessor.from_pretrained(name)
        model = model_class.from_pretrained(name)
    except (OSError, ValueError) as error:
        raise KroncError(
            f"{name} cannot be loaded ({str(error).strip().splitlines()[0]}): give as {option} a folder "
            f"with what `hf download {default} --local-dir FOLDER` fetches"
        ) from None
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    folder, revision = Path(name), getattr(model.config, "_commit_hash", None)
    files = sorted(folder.glob("*.safetensors")) + sorted(folder.glob("*.bin")) if folder.is_dir() else []
    told_apart = " ".join([name, str(revision), *map(file_sha256, files)])
    return Pretrained(processor, model.eval().to(device), device, told_apart)
