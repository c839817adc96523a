"""The options of refinement by image features."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from kronc_ns.refine.options import RefineConfig


@dataclass(kw_only=True)
class ImageOptions:
    """How solved poses are refined by image features."""

    refine_images: Literal["auto", "off"] = "auto"
    """auto: by features of the images, where held-out ones confirm it (about 0.2 s a photo); off: keypoints alone."""
    refine_region: Literal["auto", "vehicle", "frame"] = "auto"
    """Where features may lie. vehicle: inside the masks, or without them around the keypoints; frame: everywhere; auto:
    everywhere, unless the background stands still while the car turns."""

    def any_image_option(self) -> bool:
        """Whether any option differs from its default."""
        return any(getattr(self, f.name) != f.default for f in fields(ImageOptions))

    def refine_config(self, refine_focal: bool, refine_k1: bool, seed: int) -> "RefineConfig | None":
        """These options, and what is unknown of the cameras; None where images are not used."""
        from kronc_ns.refine.options import RefineConfig

        if self.refine_images == "off":
            return None
        return RefineConfig(self.refine_region, refine_focal, refine_k1, seed)
