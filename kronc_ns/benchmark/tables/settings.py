"""The rows of the paper's tables, and of those that put other solvers beside it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from kronc_ns.benchmark import paper
from kronc_ns.benchmark.peers import adam
from kronc_ns.benchmark.peers.methods import Method
from kronc_ns.benchmark.tables.table import Setting, TableOptions
from kronc_ns.fit.options import KroncConfig

_SUBSETS = (1.0, 0.75, 0.5, 0.25, 0.1)
_PRIOR_NOISE = 0.1
_ON_KEYPOINTS: tuple[Method, ...] = ("kronc", "adam", "keypoints-incremental", "keypoints-global")
_ON_BOTH: tuple[Method, ...] = ("kronc-images",)
_ON_IMAGES: tuple[Method, ...] = (
    "colmap-incremental",
    "colmap-global",
    "colmap-incremental-masked",
    "colmap-global-masked",
)


def main(options: TableOptions) -> list[Setting]:
    """Every method that starts from poses, from the paper's noise; and those that need no start."""
    rows = []
    for noise_px in options.noise_px:
        for method in ("kronc", "adam", "ceres"):
            of_paper = _paper(paper.BY_NOISE[paper.START]) if method == "adam" else {}
            rows.append(_solved({}, method, noise_px, paper=of_paper))
        rows.append(_solved({"start": "none"}, "kronc", noise_px, start=None))
        for method in ("keypoints-incremental", "keypoints-global"):
            rows.append(_solved({"start": "none"}, method, noise_px, start=None))
    return [replace(row, labels={"start": _start(row), **row.labels}) for row in rows]


def by_noise(options: TableOptions) -> list[Setting]:
    """The paper's levels of noise of the initial poses, by its solver and by ours."""
    return [
        _solved(
            {"start": f"({degrees:g} deg, {metres:g} m)"},
            method,
            noise_px,
            start=(degrees, metres),
            paper={**_paper(errors), "L2G-NeRF": _errors(paper.L2G_BY_NOISE[degrees, metres])},
        )
        for noise_px in options.noise_px
        for (degrees, metres), errors in paper.BY_NOISE.items()
        for method in ("adam", "kronc")
    ]


def by_loss(options: TableOptions) -> list[Setting]:
    """The losses that Adam minimises: in the image, in the world, or both."""
    weights = {"2D": (1.0, 0.0), "3D": (0.0, 1.0), "2D + 3D": (1.0, 1.0)}
    return [
        _solved(
            {"loss": loss},
            "adam",
            noise_px,
            config=replace(adam.PAPERS, adam=replace(adam.PAPERS.adam, weight_2d=image, weight_3d=world)),
            paper=_paper(paper.BY_LOSS[loss]),
        )
        for noise_px in options.noise_px
        for loss, (image, world) in weights.items()
    ]


def by_views(options: TableOptions) -> list[Setting]:
    """Few and many views, evenly spread over each capture."""
    return [
        _solved({"views": str(views)}, method, noise_px, views=partial(min, views), paper=_paper(errors))
        for noise_px in options.noise_px
        for views, errors in paper.BY_VIEWS.items()
        for method in ("adam", "kronc")
    ]


def by_depths(options: TableOptions) -> list[Setting]:
    """Where Adam's depths begin, from the circle.

    The prior's depths are the true ones with 10 % of noise for each view and again for each keypoint, in place of a
    network's.
    """
    rows = []
    for noise_px in options.noise_px:
        for depth_init in ("random", "prior", "prior-fixed"):
            config = replace(adam.FROM_CIRCLE, depth_init=depth_init)
            of_paper = {"paper, PSNR": f"{paper.PSNR_BY_DEPTHS[depth_init]} dB"}
            row = _solved({"depths": depth_init}, "adam", noise_px, start=None, config=config, paper=of_paper)
            rows.append(replace(row, depth_noise=None if depth_init == "random" else _PRIOR_NOISE))
    return rows


def by_subset(options: TableOptions) -> list[Setting]:
    """Ever fewer of a capture's images, without poses to start from (Adam begins on the circle).

    Bundle adjustment from the reference itself shows what the keypoints of those images allow.
    """
    rows = []
    for share in _SUBSETS:
        label, subset = {"images": f"{100 * share:.0f} %"}, partial(_share, share)
        for noise_px in options.noise_px:
            for method in (*_ON_KEYPOINTS, *_ON_BOTH):
                config = adam.FROM_CIRCLE if method == "adam" else None
                rows.append(_solved(label, method, noise_px, None, config, subset))
            limit = _solved(label, "ceres", noise_px, (0.0, 0.0), None, subset)
            rows.append(replace(limit, labels={**limit.labels, "method": "ceres from the reference"}))
        rows += [_solved(label, method, 0.0, None, None, subset) for method in _ON_IMAGES]
    return rows


def _solved(
    labels: dict[str, str],
    method: Method,
    noise_px: float,
    start: tuple[float, float] | None = paper.START,
    config: KroncConfig | None = None,
    views: Callable[[int], int] = int,
    paper: dict[str, str] | None = None,
) -> Setting:
    """A row that names its method and its noise."""
    of_images = method.startswith("colmap")
    named = {**labels, "method": method, "keypoints": "SIFT" if of_images else f"{noise_px:g} px"}
    return Setting(named, method, noise_px, start, config, views, paper=paper or {})


def _share(share: float, count: int) -> int:
    return max(3, round(share * count))


def _paper(errors: tuple[float, float]) -> dict[str, str]:
    return {"paper": _errors(errors)}


def _errors(errors: tuple[float, float]) -> str:
    return f"{errors[0]:g} deg, {errors[1]:g} cm"


def _start(row: Setting) -> str:
    return "none" if row.start is None else f"({row.start[0]:g} deg, {row.start[1]:g} m)"
