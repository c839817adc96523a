"""The training loop: pointed, resumable, the same for the same seed and device."""

import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader, Dataset

from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path
from kronc_ns.training.augmentation import augment, negative
from kronc_ns.training.loss import Loss, loss
from kronc_ns.training.network import KeypointNetwork
from kronc_ns.training.shards import Pictures

_NEGATIVES = 0.06  # share of samples without a car
_OTHERS = 3  # pictures beside the one of a sample, for other cars and surroundings
_DECAY = 0.999  # of the running mean of the weights, which is what is shipped
_WARM_UP = 300  # steps
_EVERY = 100  # steps between two lines of the log and two checkpoints


@dataclass(frozen=True)
class Training:
    """How a network is trained."""

    pictures: Path
    """Folder of rendered shards."""
    output: Path
    """Folder of the checkpoint and the log; where it has a checkpoint, training goes on from there."""
    steps: int = 12_000
    """In all; the learning rate falls to nothing over them."""
    batch: int = 32
    learning_rate: float = 1.5e-3
    weight_decay: float = 0.05
    seed: int = 0
    workers: int = 1
    """Processes that make samples."""
    minutes: float | None = None
    """Stop after so long, to go on later."""
    start: Path | None = None
    """A checkpoint whose weights to begin with, where the output folder has none."""


class _Batches(Dataset[tuple[Tensor, Tensor, Tensor]]):
    """Batch number n is the same whoever makes it."""

    def __init__(self, options: Training, first: int) -> None:
        self._options, self._first = options, first
        self._pictures = Pictures(sorted(options.pictures.glob("*.npz")))

    def __len__(self) -> int:
        return self._options.steps - self._first

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor, Tensor]:
        if index >= len(self):
            raise IndexError(index)
        step = self._first + index
        samples = [
            self._sample(np.random.default_rng([self._options.seed, step, k])) for k in range(self._options.batch)
        ]
        rgb = torch.from_numpy(np.stack([s.rgb for s in samples])).permute(0, 3, 1, 2)
        keypoints = torch.from_numpy(np.stack([s.keypoints for s in samples]).astype(np.float32))
        mask = torch.from_numpy(np.stack([s.mask for s in samples]).astype(np.float32) / 255)
        return rgb, keypoints, mask

    def _sample(self, rng: np.random.Generator) -> Any:
        chosen, *others = (self._pictures[int(k)] for k in rng.integers(len(self._pictures), size=1 + _OTHERS))
        return negative(rng, others) if rng.uniform() < _NEGATIVES else augment(chosen, others, rng)


def train(options: Training, device: str = "cpu", compiled: bool = True) -> Iterator[str]:
    """Train until the last step or the end of the time; yields lines of a log.

    ``compiled`` fuses what lies between convolutions, for which PyTorch needs a C++ compiler: 1.3 times as fast.
    """
    torch.manual_seed(options.seed)
    network = KeypointNetwork().to(torch.device(device)).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    mean = AveragedModel(network, avg_fn=_running_mean, use_buffers=True)
    optimiser = torch.optim.AdamW(
        _groups(network, options.weight_decay), lr=options.learning_rate, betas=(0.9, 0.99), fused=True
    )
    checkpoint = options.output / "checkpoint.pt"
    step = 0
    if checkpoint.is_file():
        state = torch.load(checkpoint, map_location=device, weights_only=True)
        network.load_state_dict(state["network"])
        mean.load_state_dict(state["mean"])
        optimiser.load_state_dict(state["optimiser"])
        step = state["step"]
    elif options.start is not None:
        network.load_state_dict(weights_of(options.start))
        mean.module.load_state_dict(weights_of(options.start))
    options.output.mkdir(parents=True, exist_ok=True)
    ahead = 4 if options.workers else None
    batches = DataLoader(
        _Batches(options, step),
        batch_size=None,
        num_workers=options.workers,
        prefetch_factor=ahead,
        worker_init_fn=_single_threaded,
    )
    losses = torch.compile(_losses) if compiled else _losses
    begin, recent, since = time.monotonic(), [], time.monotonic()
    network.train()
    for rgb, keypoints, mask in batches:
        for group in optimiser.param_groups:
            group["lr"] = _rate(step, options)
        images = rgb.to(device, memory_format=torch.channels_last)
        parts = losses(network, images, keypoints.to(device), mask.to(device))
        if not torch.isfinite(parts.total):
            raise KroncError(
                f"the loss of step {step} is {float(parts.total)}: expected a finite one; lower the learning rate"
            )
        optimiser.zero_grad(set_to_none=True)
        parts.total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        mean.update_parameters(network)
        step += 1
        recent.append([float(part.detach()) for part in parts])
        late = options.minutes is not None and time.monotonic() - begin > 60 * options.minutes
        if step % _EVERY == 0 or step == options.steps or late:
            means = dict(zip(Loss._fields, np.mean(recent, axis=0).round(4).tolist(), strict=True))
            speed = round(len(recent) * options.batch / (time.monotonic() - since), 1)
            line = json.dumps({"step": step, **means, "pictures_per_s": speed})
            with (options.output / "log.jsonl").open("a") as log:
                log.write(line + "\n")
            state = {"network": network.state_dict(), "mean": mean.state_dict(), "optimiser": optimiser.state_dict()}
            with atomic_path(checkpoint) as temporary:
                torch.save({**state, "step": step}, temporary)
            recent, since = [], time.monotonic()
            yield line
        if late:
            return


def _losses(network: KeypointNetwork, rgb: Tensor, keypoints: Tensor, mask: Tensor) -> Loss:
    with torch.autocast(rgb.device.type, torch.bfloat16):
        answer = network(rgb)
    return loss(answer, keypoints, mask)


def weights_of(checkpoint: Path) -> dict[str, Tensor]:
    """The running mean of the weights in a checkpoint."""
    if not checkpoint.is_file():
        raise KroncError(f"{checkpoint} does not exist: expected a checkpoint of this training")
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)["mean"]
    return {key.removeprefix("module."): value for key, value in state.items() if key.startswith("module.")}


def _running_mean(mean: Tensor, value: Tensor, count: Tensor | int) -> Tensor:
    # the first steps are not worth remembering
    decay = min(_DECAY, (1 + float(count)) / (10 + float(count)))
    return mean + (1 - decay) * (value - mean) if mean.is_floating_point() else value


def _groups(network: torch.nn.Module, decay: float) -> list[dict[str, Any]]:
    """Only weights of convolutions and linear maps decay."""
    heavy = [p for p in network.parameters() if p.ndim > 1]
    light = [p for p in network.parameters() if p.ndim <= 1]
    return [{"params": heavy, "weight_decay": decay}, {"params": light, "weight_decay": 0.0}]


def _rate(step: int, options: Training) -> float:
    if step < _WARM_UP:
        return options.learning_rate * (step + 1) / _WARM_UP
    done = (step - _WARM_UP) / max(1, options.steps - _WARM_UP)
    return options.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))


def _single_threaded(_: int) -> None:
    import cv2

    cv2.setNumThreads(0)
    torch.set_num_threads(1)
