"""How a point is seen and how that changes: written once, for the compiled loops (numbers) and for tensors.

A point (x, y, z) in camera axes lies at (u, v) = (x, y) / z in the image plane and at pixel (fx u g, fy v g) less the
principal point, with g = 1 + k1 (u^2 + v^2). A camera moves as p -> exp(w) p + t in its own axes, a point as
X -> X + d in the world's; ``near`` is 1 / z. Derivation: docs/solver.md.
"""

from typing import Any

from kronc_ns.solve.compiled import formula

BEHIND_PX = 1e4
"""Residual of a point behind its camera: an outlier to every robust loss."""
NEAR = 1e-6
"""Smallest z that is "in front", in world units."""


@formula
def pixel(u: Any, v: Any, fx: Any, fy: Any, k1: Any) -> Any:
    """Pixel (x, y) of a point in the image plane."""
    growth = 1.0 + k1 * (u * u + v * v)
    return fx * (u * growth), fy * (v * growth)


@formula
def pixel_by_plane(u: Any, v: Any, fx: Any, fy: Any, k1: Any) -> Any:
    """Derivatives of the pixel by the place in the image plane: (x by u, x by v, y by u, y by v)."""
    growth, across = 1.0 + k1 * (u * u + v * v), 2.0 * k1 * u * v
    return fx * (growth + 2.0 * k1 * u * u), fx * across, fy * across, fy * (growth + 2.0 * k1 * v * v)


@formula
def pixel_by_k1(u: Any, v: Any, fx: Any, fy: Any) -> Any:
    """Derivatives of the pixel by k1. By the logarithm of a factor of the focal length they are the pixel itself."""
    square = u * u + v * v
    return fx * (u * square), fy * (v * square)


@formula
def plane_by_turn(u: Any, v: Any) -> Any:
    """Derivatives of (u, v) by the camera's rotation vector w: three of u, three of v."""
    return -u * v, 1.0 + u * u, -v, -(1.0 + v * v), u * v, u


@formula
def plane_by_shift(u: Any, v: Any, near: Any) -> Any:
    """Derivatives of (u, v) by the camera's translation t, without the zeros: u by (x, z), v by (y, z)."""
    return near, -u * near, near, -v * near


@formula
def plane_by_point(u: Any, v: Any, near: Any, right: Any, down: Any, forward: Any) -> Any:
    """Derivatives of (u, v) by one coordinate of the point, whose column in the rotation is (right, down, forward)."""
    return near * (right - u * forward), near * (down - v * forward)
