"""Networks of the transformers package: from a folder, or by their name on the Hugging Face hub."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.errors import KroncError

_WEIGHTS = (".safetensors", ".bin")
"""Files of weights, the preferred first."""


@dataclass(frozen=True)
class Pretrained:
    """A network that is ready to run."""

    processor: Any
    """Makes its inputs of images."""
    model: Any
    device: str
    """What torch calls it: cuda or cpu."""
    name: str
    """Changes with the weights: it holds a digest of their files."""


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
    import torch
    from huggingface_hub.errors import HfHubHTTPError
    from transformers import AutoImageProcessor

    try:
        if weights and not weights.is_dir():
            raise FileNotFoundError("it is no folder")
        folder = weights or _downloaded(default)
        processor = AutoImageProcessor.from_pretrained(folder)
        model = model_class.from_pretrained(folder)
    except (OSError, ValueError, HfHubHTTPError) as error:
        raise KroncError(
            f"{weights or default} cannot be loaded ({str(error).strip().splitlines()[0]}): give as {option} a folder "
            f"with what `hf download {default} --local-dir FOLDER` fetches"
        ) from None
    device = "cuda" if torch.cuda.is_available() else "cpu"
    files = sorted(path for path in folder.iterdir() if path.suffix in _WEIGHTS)
    name = " ".join([str(weights or default), *map(file_sha256, files)])
    return Pretrained(processor, model.eval().to(device), device, name)


def _downloaded(name: str) -> Path:
    """The hub's files of a network; what an earlier run fetched where there is no internet."""
    from huggingface_hub import snapshot_download

    for weights in _WEIGHTS:
        folder = Path(snapshot_download(name, allow_patterns=["*.json", f"*{weights}"]))
        if any(folder.glob(f"*{weights}")):
            return folder
    raise FileNotFoundError(f"the hub has no {' or '.join(_WEIGHTS)} file of it")
