"""The report in a real browser: no errors, no requests, the table sorts and filters, the cameras are drawn."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from kronc_ns.show.report import write_report
from tests.conftest import BROWSER_PATIENCE_MS

pytestmark = pytest.mark.slow

VIEWS, EMPTY = 20, 4


@pytest.fixture(scope="module")
def report(solved_lap_folder: Path) -> Path:
    return write_report(solved_lap_folder)


@contextmanager
def opened(browser, report: Path, scheme: str, width: int, screenshot: Path) -> Iterator:
    """The report with its figures drawn; errors and requests are kept, and a screenshot at the end."""
    page = browser.new_context(color_scheme=scheme, viewport={"width": width, "height": 900}).new_page()
    page.set_default_timeout(BROWSER_PATIENCE_MS)
    page.errors, page.requests = [], []
    page.on("console", lambda message: page.errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.on("request", lambda request: page.requests.append(request.url))
    page.goto(report.as_uri(), wait_until="domcontentloaded")
    page.wait_for_function("document.querySelectorAll('.figure.js-plotly-plot .main-svg').length >= 4")
    yield page
    page.screenshot(path=screenshot, full_page=True)
    page.context.close()


@pytest.fixture(scope="module")
def page(browser, report: Path, screenshots: Path) -> Iterator:
    """The report in a wide window with light colours."""
    with opened(browser, report, "light", 1280, screenshots / "report_used.png") as page:
        yield page


def column(page, number: int) -> list[str]:
    return page.eval_on_selector_all(
        f"#views tbody tr:not([hidden]) td:nth-child({number})", "cells => cells.map(cell => cell.textContent)"
    )


@pytest.mark.parametrize(("scheme", "width"), [("light", 1280), ("dark", 1280), ("dark", 400)])
def test_it_loads_without_errors_and_asks_for_nothing(browser, report, screenshots, scheme, width):
    shot = screenshots / f"report_{scheme}_{width}.png"
    with opened(browser, report, scheme, width, shot) as page:
        assert page.errors == []
        assert [url for url in page.requests if not url.startswith(("file:", "data:", "blob:"))] == []
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "the page scrolls sideways"
    assert shot.stat().st_size > 50_000


def test_the_table_sorts_by_value_both_ways(page):
    heading = page.get_by_role("button", name="RMSE (px)")
    heading.click()
    *numbers, last = column(page, 6)
    assert last == "–"
    assert [float(number) for number in numbers] == sorted(float(number) for number in numbers)
    heading.click()
    *falling, last = column(page, 6)
    assert last == "–"
    assert [float(number) for number in falling] == sorted((float(number) for number in numbers), reverse=True)
    page.get_by_role("button", name="view").click()
    assert column(page, 2) == sorted(column(page, 2))
    assert len(column(page, 2)) == VIEWS


def test_the_table_filters_by_text_and_status(page):
    page.get_by_label("Find").fill("FRAME_0001")
    assert column(page, 2) == [f"images/frame_{i:05d}.png" for i in range(10, 20)]
    page.get_by_label("Find").fill("")
    page.get_by_label("Status").select_option("completed")
    assert column(page, 1) == [str(EMPTY + 1)]
    assert page.locator("#shown").text_content() == f"1 of {VIEWS} views"
    page.get_by_label("Find").fill("nothing is called so")
    assert column(page, 1) == []
    page.get_by_label("Find").fill("")
    page.get_by_label("Status").select_option("")
    assert len(column(page, 1)) == VIEWS


def test_the_cameras_are_drawn(page):
    """Where cameras and car are hidden, pixels of the 3D view change, over a wide part of it."""
    canvas = page.locator("#cameras canvas").first

    def pixels() -> np.ndarray:
        page.wait_for_timeout(1000)  # WebGL draws after the figure is there
        shot = cv2.imdecode(np.frombuffer(canvas.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        return shot[60:].astype(int)  # below the legend

    drawn = pixels()
    page.evaluate("{ Plotly.restyle('cameras', {visible: 'legendonly'}) }")
    changed = np.abs(drawn - pixels()).max(2) > 30
    page.evaluate("{ Plotly.restyle('cameras', {visible: true}) }")
    assert changed.mean() > 0.003
    assert np.ptp(np.flatnonzero(changed.any(0))) > 0.3 * changed.shape[1]


def test_images_are_shown_where_there_are_some(page):
    assert 0 < page.locator("svg.view image").count() < page.locator("svg.view").count()
    sizes = page.eval_on_selector_all("svg.view", "views => views.map(view => view.getBoundingClientRect().height)")
    assert min(sizes) > 100


def test_colours_follow_the_reader(page):
    """From light to dark without loading again: page and figures."""
    read = "[getComputedStyle(document.body).backgroundColor, document.getElementById('residuals').layout.font.color]"
    page.emulate_media(color_scheme="light")
    light = page.evaluate(read)
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(500)
    dark = page.evaluate(read)
    assert light == ["rgb(255, 255, 255)", "#1c2128"]
    assert dark == ["rgb(20, 23, 28)", "#e6e9ee"]
