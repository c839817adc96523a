"""fleet.html: one page of a whole fleet, its failures first, which a browser opens at once."""

import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from kronc_ns.fleet.job import Job
from kronc_ns.fleet.table import Table
from kronc_ns.show.report.templates import source

PAGE = "fleet.html"
_ORDER = ("error", "failed", "weak", "converged")
_MOST_ROWS = 20_000  # of which a browser has 10 MB to read
_COLUMNS = (
    "capture", "status", "reason", "views", "solved", "rmse_px", "sigma_rot_deg", "sigma_trans_m", "focal_px",
    "seconds", "attempts", "node", "thumbnail", "has_report",
)  # fmt: skip
_DIGITS = {"rmse_px": 2, "sigma_rot_deg": 3, "sigma_trans_m": 4, "focal_px": 1, "seconds": 2}
_HISTOGRAMS: tuple[tuple[str, str, str, float], ...] = (
    ("rmse_px", "reprojection RMSE", "px", 1.0),
    ("sigma_rot_deg", "standard deviation, rotation", "°", 1.0),
    ("sigma_trans_m", "standard deviation, centre", "cm", 100.0),
    ("seconds", "time of a capture", "s", 1.0),
    ("views", "views", "", 1.0),
)
_BINS, _TAIL = 24, 99.0
_ENVIRONMENT = Environment(
    loader=PackageLoader("kronc_ns.fleet", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip


def write_page(job: Job, table: Table, named: int) -> tuple[tuple[str, str, str], ...]:
    """Write fleet.html; returns (status, name, reason) of the first ``named`` captures that are not converged."""
    rows: dict[str, list[list[Any]]] = {status: [] for status in _ORDER}
    values: dict[str, list[np.ndarray]] = {name: [] for name, *_ in _HISTOGRAMS}
    counts: Counter[str] = Counter()
    nodes: set[str] = set()
    seconds = views = solved = 0.0
    for part in table.parts(_COLUMNS):
        for name, kept in values.items():
            kept.append(part[name].to_numpy().astype(float))
        seconds += float(values["seconds"][-1].sum())
        views += float(values["views"][-1].sum())
        solved += float(part["solved"].to_numpy().sum())
        nodes.update(part["node"].to_pylist())
        for row in zip(*(part[column].to_pylist() for column in _COLUMNS), strict=True):
            status = row[1]
            counts[status] += 1
            if len(rows[status]) < _MOST_ROWS:
                rows[status].append([_short(*cell) for cell in zip(_COLUMNS, row, strict=True)])
    ordered = [row for status in _ORDER for row in sorted(rows[status])][:_MOST_ROWS]
    done = sum(counts.values())
    page = _ENVIRONMENT.get_template("page.html").render(
        title=str(job.output),
        version=job.version,
        captures=str(job.captures),
        facts=[
            ("captures", f"{done:,}", _count(len(nodes - {""}), "node")),
            *((status, f"{counts[status]:,}", _share(counts[status], done)) for status in reversed(_ORDER)),
            ("views solved", f"{solved:,.0f}", f"of {views:,.0f}"),
            ("work", f"{seconds / 3600:.2f} h", f"{seconds / max(done, 1):.2f} s a capture, waiting included"),
        ],
        histograms=[_histogram(values[name], what, unit, by) for name, what, unit, by in _HISTOGRAMS],
        left_out=done - len(ordered),
        style=source("page.css") + _file("page.css"),
        script=_file("page.js"),
        data=_json(_packed(ordered)),
    )
    (job.output / PAGE).write(page.encode())
    first = [row for row in ordered if row[1] != "converged"][:named]
    return tuple((str(row[1]), str(row[0]), str(row[2])) for row in first)


def _short(column: str, value: Any) -> Any:
    digits = _DIGITS.get(column)
    return value if digits is None or value is None else round(value, digits)


def _count(number: int, what: str) -> str:
    return f"on {number} {what}{'' if number == 1 else 's'}"


def _share(count: int, whole: int) -> str:
    return f"{100 * count / whole:.1f} %" if whole else ""


def _packed(rows: Sequence[list[Any]]) -> dict[str, Any]:
    """Rows for the script: what many have in common (reasons, nodes) is written once."""
    common: dict[str, dict[Any, int]] = {"status": {}, "reason": {}, "node": {}, "thumbnail": {}}
    at = {name: _COLUMNS.index(name) for name in common}
    packed = []
    for row in rows:
        row = [*row]
        for name, index in at.items():
            row[index] = common[name].setdefault(row[index], len(common[name]))
        packed.append(row)
    return {"columns": _COLUMNS, "common": {name: [*values] for name, values in common.items()}, "rows": packed}


def _histogram(parts: Sequence[Float[np.ndarray, "_"]], what: str, unit: str, factor: float) -> dict[str, Any]:
    """Bars of what most captures have; the hundredth part that is beyond is in the last."""
    values = factor * np.concatenate([np.zeros(0), *parts])
    values = values[np.isfinite(values)]
    if not len(values):
        return {"what": what, "bars": [], "middle": "", "low": "", "high": ""}
    low, high = float(values.min()), float(np.percentile(values, _TAIL))
    high = high if high > low else low + 1.0
    counts, _ = np.histogram(np.minimum(values, high), _BINS, (low, high))
    width = 100 / _BINS
    bars = [
        {"x": i * width, "width": 0.9 * width, "height": 40 * count / counts.max(), "count": int(count)}
        for i, count in enumerate(counts)
    ]
    beyond = "≥ " if values.max() > high else ""
    return {
        "what": what,
        "bars": bars,
        "middle": f"median {np.median(values):.3g} {unit}",
        "low": f"{low:.3g}",
        "high": f"{beyond}{high:.3g} {unit}",
    }


def _file(name: str) -> Markup:
    assert _ENVIRONMENT.loader is not None
    return Markup(_ENVIRONMENT.loader.get_source(_ENVIRONMENT, name)[0])


def _json(content: Any) -> Markup:
    """JSON that may stand in a script element, whatever names are in it."""
    text = json.dumps(content, separators=(",", ":"))
    return Markup(text.replace("&", r"\u0026").replace("<", r"\u003c").replace(">", r"\u003e"))
