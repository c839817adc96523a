"""What the paper reports, to stand beside what is measured: errors in (degrees, centimetres)."""

START = (4.0, 0.5)
"""Its usual noise of initial poses: degrees, metres."""
BY_NOISE = {
    (4.0, 0.5): (0.65, 3.06),
    (5.0, 0.7): (0.75, 3.07),
    (5.0, 1.5): (1.35, 3.10),
    (6.0, 2.0): (3.79, 3.16),
    (6.0, 2.5): (2.34, 2.13),
    (7.0, 3.0): (6.54, 6.21),
}
"""By noise of the start (degrees, metres), on CarPatch."""
L2G_BY_NOISE = {
    (4.0, 0.5): (0.50, 5.26),
    (5.0, 0.7): (0.51, 6.25),
    (5.0, 1.5): (8.19, 78.0),
    (6.0, 2.0): (14.38, 177.0),
    (6.0, 2.5): (24.39, 269.0),
    (7.0, 3.0): (31.29, 348.0),
}
"""L2G-NeRF's, of the same table."""
BY_VIEWS = {
    5: (1.72, 3.37),
    10: (0.73, 3.31),
    20: (1.62, 3.24),
    30: (2.24, 3.12),
    40: (1.82, 3.10),
    50: (1.18, 3.07),
    60: (0.93, 3.06),
    70: (0.69, 3.07),
}
"""By number of views, from (4 deg, 0.5 m)."""
BY_LOSS = {"2D": (0.75, 3.10), "3D": (0.68, 3.19), "2D + 3D": (0.65, 3.06)}
"""By the losses that Adam minimises, from (4 deg, 0.5 m)."""
PSNR_BY_DEPTHS = {"random": 21.89, "prior": 20.53, "prior-fixed": 17.54}
"""By where the depths start, masked cars of the KRONC data set (dB); no pose errors are given."""
