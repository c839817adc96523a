"""Renderings without their background: colour and opacity are what was composed."""

import pytest
import torch

pytest.importorskip("nerfstudio")

from kronc_ns.plugin.transparency import rgba

pytestmark = pytest.mark.nerfstudio
COLOURS = {"random": torch.zeros(3), "black": torch.zeros(3), "white": torch.ones(3)}


@pytest.mark.parametrize("background", [*COLOURS, torch.tensor([0.2, 0.9, 0.4])], ids=str)
def test_colour_and_opacity_are_what_was_composed(background):
    colour, opacity = torch.rand(4, 5, 3), 0.1 + 0.9 * torch.rand(4, 5, 1)
    behind = COLOURS[background] if isinstance(background, str) else background
    seen = opacity * colour + (1 - opacity) * behind
    given = background if isinstance(background, str) else background.expand(seen.shape)
    torch.testing.assert_close(rgba(seen, opacity, given), torch.cat([colour, opacity], dim=-1), atol=1e-5, rtol=0)


def test_where_nothing_was_rendered_all_is_finite_and_transparent():
    found = rgba(torch.ones(7, 3), torch.zeros(7, 1), "white")
    assert found.isfinite().all()
    assert (found[:, 3] == 0).all()
