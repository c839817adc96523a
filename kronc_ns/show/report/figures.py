"""The report's figures in plotly. ``meta`` of a trace names its colour: a variable of page.css, light or dark."""

import html
import math
from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float
from plotly.subplots import make_subplots

from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import posed, transform
from kronc_ns.scene import Scene
from kronc_ns.show.motion import CROWDED, aligned_start, frustum_depth
from kronc_ns.solution import Solution, ViewReport, ViewStatus

_OUTLINE = (1, 2, 3, 4, 1, 0, 2, 5, 3, 0, 4, 5)
"""A camera's eight edges as one line through centre (0) and corners (1 to 4), lifted twice (5)."""
_BINS = 40
_MARKED_STEPS = 60
"""Up to so many steps each is marked by a dot."""
_MARKS = ((1, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)), (2, (1.0, 2.0, 5.0)))
"""Marks between the powers of ten, for axes that span up to so many."""


def cameras_3d(scene: Scene, solution: Solution) -> go.Figure | None:
    """Cameras before (moved onto the solved ones by the best similarity) and after, and keypoints; None if none."""
    traces: list[go.Scatter3d] = []
    after, before = solution.c2w, aligned_start(solution)
    depth = frustum_depth(after if posed(after).any() else before)
    if posed(before).any():
        start = f"before: {solution.init}"
        traces.append(_outlines(solution, before, posed(before), depth, name=start, meta="before", width=1))
    for status in (ViewStatus.SOLVED, ViewStatus.COMPLETED):
        chosen = solution.views_that_are(status) & posed(after)
        if not chosen.any():
            continue
        traces.append(_outlines(solution, after, chosen, depth, name=status.value, meta=status.value))
        labels = [_label(view) for view, take in zip(solution.views, chosen.tolist(), strict=True) if take]
        traces.append(
            go.Scatter3d(
                **_xyz(after[chosen][..., 3]),
                mode="markers",
                marker={"size": 1.5 if len(after) < CROWDED else 1},
                meta=status.value,
                text=labels,
                hoverinfo="text",
                showlegend=False,
                legendgroup=status.value,
            )
        )
    traces += _car(scene, solution.points)
    if not traces:
        return None
    places = np.concatenate([after[..., 3], before[..., 3], solution.points])
    places = places[np.isfinite(places).all(-1)]
    low, high = (places.min(0) - depth).tolist(), (places.max(0) + depth).tolist()
    size = [b - a for a, b in zip(low, high, strict=True)]
    figure = go.Figure(traces)
    figure.update_layout(
        _layout(height=560),
        scene={
            # true proportions, and everything in the picture
            "aspectmode": "manual",
            "aspectratio": {axis: size[i] / max(size) for i, axis in enumerate("xyz")},
            **{f"{axis}axis": {"title": axis, "range": [low[i], high[i]]} for i, axis in enumerate("xyz")},
            "camera": {"eye": {"x": 0.72, "y": -0.72, "z": 0.5}, "center": {"x": 0, "y": 0, "z": -0.14}},
        },
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
    )
    return figure


def residual_histogram(error: Float[np.ndarray, "n j"], inlier: Bool[np.ndarray, "n j"]) -> go.Figure | None:
    """Reprojection errors of all detections in views with a pose, those off the axis in the last bar; None if none."""
    known = ~np.isnan(error)
    if not inlier.any():
        return None
    end = 1.5 * float(error[inlier].max())
    edges = np.linspace(0, end, _BINS + 1)
    width = end / _BINS
    figure = go.Figure()
    for name, chosen, meta in (("explained", inlier, "solved"), ("not explained", known & ~inlier, "failed")):
        values = error[chosen]
        counts, _ = np.histogram(np.minimum(values, edges[-1]), edges)
        text = [f"{low:.2f} to {low + width:.2f} px: {count}" for low, count in zip(edges, counts, strict=False)]
        text[-1] = f"{edges[-2]:.2f} px and more: {counts[-1]}"
        figure.add_trace(
            go.Bar(
                x=edges[:-1] + width / 2,
                y=counts,
                width=width,
                name=f"{name}: {len(values)}",
                meta=meta,
                hovertext=text,
                hoverinfo="text",
            )
        )
    figure.update_layout(_layout(), barmode="stack", bargap=0)
    figure.update_xaxes(title="reprojection error (px)", range=[0, end])
    figure.update_yaxes(title="detections")
    return figure


def convergence(solution: Solution) -> go.Figure | None:
    """The solver's loss over its steps; None where none were recorded, or none was finite."""
    steps, loss = (solution.history.get(key, ()) for key in ("step", "loss"))
    finite = [value for value in loss if math.isfinite(value)]
    if not steps or not finite:
        return None
    mode = "lines+markers" if len(steps) <= _MARKED_STEPS else "lines"
    figure = go.Figure(go.Scatter(x=list(steps), y=list(loss), mode=mode, meta="solved", name="loss"))
    figure.update_layout(_layout(), showlegend=False)
    figure.update_xaxes(title="step")
    figure.update_yaxes(title="loss", **_axis(finite))
    return figure


def uncertainties(views: Sequence[ViewReport]) -> go.Figure | None:
    """Standard deviations of rotation and centre, view by view; None where none are known."""
    rotation = [view.sigma_rot_deg for view in views]
    centre = [None if view.sigma_trans_m is None else 100 * view.sigma_trans_m for view in views]
    rows = [(1, "rotation (deg)", rotation), (2, "centre (cm)", centre)]
    if not all(any(values) for _, _, values in rows):
        return None
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.08)
    for status, symbol in ((ViewStatus.SOLVED, "circle"), (ViewStatus.COMPLETED, "diamond-open")):
        chosen = [i for i, view in enumerate(views) if view.status is status]
        for row, _, values in rows if chosen else ():
            trace = go.Scatter(
                x=[i + 1 for i in chosen],
                y=[values[i] for i in chosen],
                mode="markers",
                marker={"size": 5, "symbol": symbol},
                meta=status.value,
                name=status.value,
                legendgroup=status.value,
                showlegend=row == 1,
                text=[_label(views[i]) for i in chosen],
                hoverinfo="text",
            )
            figure.add_trace(trace, row=row, col=1)
    for row, title, values in rows:
        figure.update_yaxes(title=title, **_axis([value for value in values if value]), row=row, col=1)
    figure.update_layout(_layout(height=420))
    figure.update_xaxes(title="view", row=2, col=1)
    return figure


def _layout(height: int = 360) -> dict:
    return {
        "template": "none",
        "height": height,
        "margin": {"l": 64, "r": 16, "t": 36, "b": 48},
        "legend": {
            "traceorder": "normal",
            "orientation": "h",
            "x": 0,
            "y": 1,
            "xanchor": "left",
            "yanchor": "bottom",
            "itemsizing": "constant",
        },
        "uirevision": "kept",  # the reader's zoom outlives a change between light and dark
        "hoverlabel": {"align": "left"},
    }


def _axis(values: Sequence[float]) -> dict:
    """A logarithmic axis, unless a factor of two spans all values or one is 0.

    Its marks are whole numbers, for plotly writes a mere 2 for 0.2 and for 20.
    """
    if min(values) <= 0:
        return {}
    low, high = math.log10(min(values)), math.log10(max(values))
    if high - low < math.log10(2):
        return {}
    digits = next((digits for decades, digits in _MARKS if high - low <= decades), (1.0,))
    exponents = range(math.floor(low), math.ceil(high) + 1)
    marks = [float(f"{digit}e{exponent}") for exponent in exponents for digit in digits]
    return {"type": "log", "tickvals": marks, "ticktext": [f"{mark:g}" for mark in marks]}


def _outlines(
    solution: Solution,
    c2w: Float[np.ndarray, "n 3 4"],
    chosen: Bool[np.ndarray, "n"],
    depth: float,
    name: str,
    meta: str,
    width: int = 2,
) -> go.Scatter3d:
    """Cameras of the chosen views as pyramids over their image."""
    pyramids = [_pyramid(solution.camera_of(i)) for i in np.flatnonzero(chosen).tolist()]
    line = transform(c2w[chosen], depth * np.stack(pyramids)).reshape(-1, 3)
    return go.Scatter3d(
        **_xyz(line), mode="lines", line={"width": width}, name=name, meta=meta, legendgroup=meta, hoverinfo="skip"
    )


def _pyramid(camera: Camera) -> Float[np.ndarray, "o 3"]:
    """Around the image at a distance of 1, by way of the centre; NaN lifts the pen."""
    right, down = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    corners = [[-right, -down, 1], [right, -down, 1], [right, down, 1], [-right, down, 1]]
    return np.array([[0.0, 0.0, 0.0], *corners, [math.nan] * 3])[[*_OUTLINE]]


def _car(scene: Scene, points: Float[np.ndarray, "j 3"]) -> list[go.Scatter3d]:
    """The solved keypoints, and lines between those that the schema joins."""
    solved = np.isfinite(points).all(-1)
    edges = [edge for edge in scene.schema.skeleton if solved[list(edge)].all()]
    names = [name for name, known in zip(scene.schema.keypoints, solved.tolist(), strict=True) if known]
    gap = np.full((len(edges), 1, 3), math.nan)
    traces = []
    if edges:
        lines = np.concatenate([points[np.array(edges)], gap], axis=1).reshape(-1, 3)
        shared = {"meta": "points", "legendgroup": "points", "showlegend": False, "hoverinfo": "skip"}
        traces.append(go.Scatter3d(**_xyz(lines), mode="lines", line={"width": 2}, **shared))
    if names:
        traces.append(
            go.Scatter3d(
                **_xyz(points[solved]),
                mode="markers",
                marker={"size": 3},
                name="keypoints",
                meta="points",
                legendgroup="points",
                text=[html.escape(name) for name in names],
                hoverinfo="text",
            )
        )
    return traces


def _label(view: ViewReport) -> str:
    lines = [html.escape(view.name), view.status.value]
    if view.rmse_px is not None:
        lines.append(f"RMSE {view.rmse_px:.2f} px, {view.inliers} of {view.visible} keypoints")
    if view.sigma_rot_deg is not None and view.sigma_trans_m is not None:
        lines.append(f"± {view.sigma_rot_deg:.2f} deg, {100 * view.sigma_trans_m:.1f} cm")
    return "<br>".join(lines)


def _xyz(points: Float[np.ndarray, "n 3"]) -> dict[str, np.ndarray]:
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))
