"""The report's page: what it says agrees with the solution, stands by itself and holds no foreign markup."""

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import plotly.graph_objects as go
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.verdict import inliers
from kronc_ns.geometry.poses import invert, transform
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.show.report import figures, write_report
from kronc_ns.show.report.overlays import choose_views, overlay
from kronc_ns.solution import Status, ViewStatus
from tests.conftest import scene_of

EMPTY = 4  # a view without keypoints


@pytest.fixture(scope="module")
def solved_lap(lap):
    """A walk with a view without keypoints, solved."""
    keypoints = lap.keypoints.copy()
    keypoints[EMPTY, :, 2] = 0
    scene = scene_of(replace(lap, keypoints=keypoints))
    return scene, solve_scene(scene, KroncConfig())


@pytest.fixture
def folder(tmp_path, solved_lap):
    return written(tmp_path, *solved_lap)


def written(tmp_path, scene, solution):
    claim_output(tmp_path / "out")
    write_solution(tmp_path / "out", scene, solution, tmp_path, "abc")
    return tmp_path / "out"


class Page(HTMLParser):
    """Elements by tag, cells of the table and text of a page."""

    def __init__(self, page: str):
        super().__init__()
        self.elements: list[tuple[str, dict]] = []
        self.rows: list[list[str]] = []
        self.inside: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self.inside.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag == "td":
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        while self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data):
        if self.inside and self.inside[-1] in ("script", "style"):
            return
        self.text += data
        if "td" in self.inside:
            self.rows[-1][-1] += data


def page_of(folder) -> Page:
    return Page(write_report(folder).read_text(encoding="utf-8"))


def test_every_view_is_in_the_table(folder, solved_lap):
    _, solution = solved_lap
    rows = page_of(folder).rows[1:]
    assert [row[1] for row in rows] == list(solution.names)
    assert [row[2] for row in rows] == [view.status.value for view in solution.views]
    assert [int(row[4]) for row in rows] == [view.inliers for view in solution.views]
    assert rows[EMPTY][5] == "–"
    assert "0 keypoints, at least 4 are needed" in rows[EMPTY][8]
    assert [row[5] for row in rows[:EMPTY]] == [f"{view.rmse_px:.2f}" for view in solution.views[:EMPTY]]


def test_status_reason_command_and_absent_images_are_said(folder, solved_lap):
    _, solution = solved_lap
    text = page_of(folder).text
    for said in ("converged", solution.reason, "19 of 20", "No image was found", "torch", "python"):
        assert said in text


def test_it_stands_by_itself(folder):
    """Nothing is loaded from elsewhere: no address in any element, and a policy that forbids it to scripts too."""
    elements = page_of(folder).elements
    addresses = [value for _, attrs in elements for key, value in attrs.items() if key in ("src", "href") and value]
    assert not [address for address in addresses if not address.startswith("data:")]
    assert not [tag for tag, _ in elements if tag in ("link", "iframe", "object")]
    (policy,) = [attrs["content"] for _, attrs in elements if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy


def test_names_are_text_wherever_they_stand(tmp_path, solved_lap):
    """Also in the figures' JSON, which must not end its script element early."""
    scene, solution = solved_lap
    wild = '</script><img src=x onerror="alert(1)">&amp;.png'
    names = (wild, *solution.names[1:])
    views = (replace(solution.views[0], name=wild), *solution.views[1:])
    folder = written(tmp_path, replace(scene, names=names), replace(solution, names=names, views=views))
    page = page_of(folder)
    assert not [tag for tag, _ in page.elements if tag == "img"]
    assert page.rows[1][1] == wild
    for plot in plots(folder).values():
        assert "<img" not in json.dumps(plot)


def plots(folder) -> dict[str, dict]:
    page = write_report(folder).read_text(encoding="utf-8")
    found = re.findall(r'id="(\w+)"><script type="application/json">(.*?)</script>', page, re.DOTALL)
    return {name: json.loads(text) for name, text in found}


def test_all_figures_are_there(folder):
    assert set(plots(folder)) == {"cameras", "residuals", "convergence", "uncertainties"}


@pytest.mark.parametrize("status", [Status.WEAK, Status.FAILED])
def test_a_failed_solution_is_reported_with_its_reason(tmp_path, solved_lap, status):
    scene, solution = solved_lap
    views = tuple(replace(v, status=ViewStatus.FAILED, rmse_px=None, reason="lost it") for v in solution.views)
    views = tuple(replace(view, sigma_rot_deg=None, sigma_trans_m=None) for view in views)
    lost = np.full_like(solution.c2w, math.nan)
    nothing = replace(
        solution, status=status, reason="nothing fits", views=views, c2w=lost, initial_c2w=lost, rmse_px=math.nan,
        points=np.full_like(solution.points, math.nan), median_px=math.nan, history={},
    )  # fmt: skip
    folder = written(tmp_path, scene, nothing)
    assert plots(folder) == {}
    text = page_of(folder).text
    for said in (status.value, "nothing fits", "No camera has a pose", "recorded no steps", "lost it", "unknown"):
        assert said in text


def test_a_report_of_an_earlier_result_is_replaced_and_goes_with_it(folder, solved_lap):
    first = write_report(folder).read_text()
    assert write_report(folder).read_text() == first
    claim_output(folder)
    assert not (folder / "report.html").exists()


def test_somebody_elses_report_is_kept(folder):
    (folder / "report.html").write_text("mine")
    with pytest.raises(KroncError, match="not written by kronc: move it away"):
        write_report(folder)
    claim_output(folder)
    assert (folder / "report.html").read_text() == "mine"


def test_an_unsolved_folder_is_named(walk_folder):
    with pytest.raises(KroncError, match=r"kronc.json does not exist"):
        write_report(walk_folder)
    assert not (walk_folder / "report.html").exists()


def test_worst_and_median_views_are_chosen(solved_lap):
    _, solution = solved_lap
    chosen = choose_views(solution)
    errors = sorted((view.rmse_px for view in solution.views if view.rmse_px is not None), reverse=True)
    by_kind = {kind: [solution.views[i].rmse_px for k, i in chosen if k == kind] for kind, _ in chosen}
    assert by_kind["worst"] == errors[:3]
    assert by_kind["median"] == errors[8:11]  # of 19
    assert [i for kind, i in chosen if kind == "completed"] == [EMPTY]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7])
def test_no_view_is_shown_twice_however_few_there_are(solved_lap, count):
    _, solution = solved_lap
    views = [view for view in solution.views if view.status is ViewStatus.SOLVED][:count]
    chosen = [i for _, i in choose_views(replace(solution, views=views))]
    assert sorted(chosen) == sorted(set(chosen))
    assert len(chosen) == min(count, 6)


def test_overlays_show_images_where_the_points_are_in_them(tmp_path, walk_folder):
    """A distorted photo of a bright dot at each projected point: the overlay's pixels are the dots'."""
    scene = load_scene(walk_folder)
    camera = replace(scene.camera, k1=-0.15)
    solution = replace(solve_scene(scene, KroncConfig()), camera=camera)
    view = solution.c2w[2]
    body = transform(invert(view), solution.points)
    ideal = body[:, :2] / body[:, 2:]
    bent = ideal * (1 + camera.k1 * np.square(ideal).sum(1, keepdims=True))
    expected = bent * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    image = np.full((camera.height, camera.width, 3), 60, np.uint8)
    (walk_folder / "images").mkdir(exist_ok=True)
    cv2.imwrite(str(walk_folder / scene.names[2]), image)
    _, inlier = inliers(scene, solution)
    shown = overlay("worst", 2, scene, solution, inlier, walk_folder)
    names = list(scene.schema.keypoints)
    met = [mark for mark in shown.marks if mark.solved]
    assert len(met) > 5
    np.testing.assert_allclose([m.solved for m in met], expected[[names.index(m.name) for m in met]], atol=1e-6)
    left, top, right, bottom = shown.box
    assert 0 <= left < right <= camera.width
    assert 0 <= top < bottom <= camera.height
    assert all(left <= mark.u <= right and top <= mark.v <= bottom for mark in shown.marks)
    assert shown.image.startswith("data:image/jpeg;base64,")


def test_before_and_after_coincide_where_the_start_differs_by_a_similarity_only(solved_lap):
    scene, solution = solved_lap
    rotation = so3_exp(np.array([0.3, -0.2, 1.0]))
    moved = solution.c2w.copy()
    moved[..., :3] = rotation @ moved[..., :3]
    moved[..., 3] = 2.5 * moved[..., 3] @ rotation.T + (1.0, 2.0, 3.0)
    figure = figures.cameras_3d(scene, replace(solution, initial_c2w=moved))
    before = next(trace for trace in figure.data if trace.meta == "before")
    centres = np.stack([before.x, before.y, before.z], 1)[5::12]  # of a camera's twelve vertices the sixth
    np.testing.assert_allclose(centres, solution.c2w[..., 3], atol=1e-4)


def test_the_histogram_counts_every_detection_once(solved_lap):
    scene, solution = solved_lap
    error, inlier = inliers(scene, solution)
    figure = figures.residual_histogram(error, inlier)
    assert isinstance(figure, go.Figure)
    explained, not_explained = (int(np.sum(trace.y)) for trace in figure.data)
    assert explained == int(inlier.sum())
    assert explained + not_explained == int((~np.isnan(error)).sum())
