"""Runs inside OpenPifPaf's environment: its checkpoint's intensity fields as ONNX, and what is known of them as JSON.

    python export_fields.py CHECKPOINT OUTPUT.onnx OUTPUT.json

Tracing the network as it is would fix the size of the image. So its last layers are written out here as the papers
describe them (a convolution, sub-pixel shuffling that overlaps by one cell, an activation per component), compared
with the network's own output, and exported for images of any size. The result is what
`kronc_ns.capture.detection.cif` decodes. Needs nothing of kronc_ns, and works under Python 3.10 with torch 1.13.
"""

import hashlib
import json
import sys
from pathlib import Path

import openpifpaf  # pyright: ignore[reportMissingImports]
import torch

COMPONENTS = 5


class IntensityFields(torch.nn.Module):
    """Image [1, 3, h, w] -> [1, K, 5, h', w']: confidence, x and y voted for (cells), spread, size (cells)."""

    def __init__(self, model, head):
        super().__init__()
        self.base, self.count, self.upsampling = model.base_net, head.meta.n_fields, head.meta.upsample_stride
        (self.convolution,) = (layer for layer in head.modules() if isinstance(layer, torch.nn.Conv2d))

    def forward(self, image):
        """The fields of one image, normalised as in training."""
        raw = torch.nn.functional.pixel_shuffle(self.convolution(self.base(image)), self.upsampling)
        if self.upsampling > 1:
            raw = raw[:, :, : 1 - self.upsampling, : 1 - self.upsampling]
        raw = raw.reshape(1, self.count, COMPONENTS, raw.shape[2], raw.shape[3])
        spread, confidence, x, y, size = raw.unbind(2)
        x = x + torch.arange(x.shape[3], dtype=x.dtype, device=x.device)
        y = y + torch.arange(y.shape[2], dtype=y.dtype, device=y.device)[:, None]
        # the spread is learnt as a logarithm
        parts = (torch.sigmoid(confidence), x, y, torch.exp(spread), torch.nn.functional.softplus(size))
        return torch.stack(parts, dim=2)


def main(checkpoint, model_file, card_file):
    """Load, compare with the network's own fields, export."""
    factory = openpifpaf.network.Factory()
    factory.checkpoint = checkpoint
    model, _ = factory.factory()
    model.eval()
    heads = [head for head in model.head_nets if isinstance(head.meta, openpifpaf.headmeta.Cif)]
    if len(heads) != 1:
        sys.exit(f"{checkpoint} has {len(heads)} heads of intensity fields: expected one")
    (head,), meta = heads, heads[0].meta
    fields = IntensityFields(model, head).eval()

    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for size in ((97, 129), (129, 81)):
            image = torch.randn(1, 3, *size, generator=generator)
            theirs, ours = head(model.base_net(image))[:, :, [1, 2, 3, 4]], fields(image)[:, :, [0, 1, 2, 4]]
            if ours.shape != theirs.shape or not torch.allclose(ours, theirs, atol=1e-4):
                sys.exit(f"the fields of {checkpoint} are laid out differently: expected a model of OpenPifPaf 0.13")

    torch.onnx.export(
        fields,
        (torch.zeros(1, 3, 97, 129),),
        model_file,
        input_names=["image"],
        output_names=["fields"],
        dynamic_axes={"image": {2: "height", 3: "width"}, "fields": {3: "rows", 4: "columns"}},
        opset_version=14,
    )
    file = checkpoint_file(checkpoint)
    card = {
        "keypoints": list(meta.keypoints),
        "stride": meta.stride,
        "checkpoint": {"name": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()},
    }
    Path(card_file).write_text(json.dumps(card), encoding="utf-8")


def checkpoint_file(checkpoint):
    """Where the checkpoint lies: itself, or what torch.hub keeps under the last part of its address."""
    if Path(checkpoint).is_file():
        return Path(checkpoint)
    address = openpifpaf.CHECKPOINT_URLS[checkpoint]
    return Path(torch.hub.get_dir()) / "checkpoints" / address.rsplit("/", 1)[-1]


if __name__ == "__main__":
    main(*sys.argv[1:])
