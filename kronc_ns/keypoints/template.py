"""A parametric passenger car with the 66 named points: a model to find first poses with, and a prior on its shape.

Axes: x forward, y left, z up, metres; the origin lies midway between the bumper ends, on the plane of symmetry, on the
ground. The car is authored from published dimensions and from how cars are built; nothing is fitted to labelled shapes.
"""

from dataclasses import astuple, dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.poses import unit
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema

PUBLISHED_MM: dict[str, tuple[int, int, int, int]] = {
    "Fiat 500": (3571, 1627, 1488, 2300), "Ford Focus": (4378, 1825, 1471, 2700), "VW Passat": (4767, 1832, 1456, 2786),
    "VW up!": (3600, 1645, 1504, 2420), "Hyundai i10": (3670, 1680, 1480, 2425), "Mercedes C": (4751, 1820, 1438, 2865),
    "Toyota Yaris": (3940, 1745, 1500, 2560), "Toyota Corolla": (4630, 1780, 1435, 2700),
    "Ford Fiesta": (4040, 1735, 1476, 2493), "VW Golf": (4284, 1789, 1491, 2636), "VW Tiguan": (4486, 1839, 1643, 2681),
    "Honda Jazz": (4044, 1694, 1526, 2517), "Peugeot 308": (4367, 1852, 1441, 2675),
    "Renault Clio": (4050, 1798, 1440, 2583), "Toyota RAV4": (4600, 1855, 1685, 2690),
    "Nissan Juke": (4210, 1800, 1595, 2636), "Volvo XC60": (4688, 1902, 1658, 2865), "BMW 3": (4709, 1827, 1442, 2851),
    "Nissan Qashqai": (4425, 1835, 1625, 2665), "Toyota Camry": (4885, 1840, 1445, 2825),
    "Hyundai Tucson": (4500, 1865, 1650, 2680), "Tesla Model 3": (4694, 1850, 1443, 2875),
}  # fmt: skip
"""Length, width without mirrors, height and wheelbase of city cars, hatchbacks, saloons and SUVs, as makers state.

Mean and covariance of the first four dimensions come from here: long cars are wide and have long wheelbases; a prior
that took the four as independent would allow absurd overhangs.
"""


@dataclass(frozen=True)
class CarDimensions:
    """Dimensions of a passenger car in metres (shares are plain numbers); the defaults are the average car.

    Heights near the belt line are measured from it, and it from the roof: an SUV is raised as a whole.
    """

    length: float = 4.331
    """Bumper to bumper."""
    width: float = 1.793
    """Across the doors, without mirrors."""
    height: float = 1.515
    """Ground to the highest point of the roof."""
    wheelbase: float = 2.656
    """Front axle to rear axle."""
    front_share: float = 0.485
    """Front overhang as a share of both overhangs."""
    wheel_radius: float = 0.325
    """Ground to wheel centre."""
    door_setback: float = 0.48
    """Front axle back to the front edge of the front door."""
    door_share: float = 0.56
    """Length of the front door as a share of the run from its front edge to the rear wheel arch."""
    windscreen_setback: float = 1.12
    """Front axle back to the upper corners of the windscreen."""
    tail_run: float = 0.85
    """Rear bumper forward to the upper corners of the rear screen: short on an SUV, long on a saloon."""
    glass_height: float = 0.55
    """Belt line up to the highest point of the roof, at the B pillar."""
    roof_inset: float = 0.32
    """Lean of the sides: upper corners of the windscreen inward of the car's widest line."""
    sill_height: float = 0.29
    """Lower edge of the doors."""
    lamp_drop: float = 0.25
    """Belt line down to the middle of the headlamps."""
    lamp_inner: float = 0.48
    """Plane of symmetry to the inner edge of a headlamp."""
    nose_sweep: float = 0.55
    """How far the front, followed at lamp height to the car's full width, curves back in plan."""
    tail_lamp_drop: float = 0.05
    """Belt line down to the middle of the tail lamps."""
    tail_lamp_inner: float = 0.52
    """Plane of symmetry to the inner edge of a tail lamp."""
    tail_sweep: float = 0.36
    """How far the rear, followed at lamp height to the car's full width, curves forward in plan."""
    boot_sill: float = 0.60
    """Lower edge of the boot lid or tailgate."""
    rear_plate: float = 0.78
    """Middle of the rear number plate: mostly on the boot lid, sometimes in the bumper."""


DEVIATIONS = CarDimensions(
    length=0.394, width=0.074, height=0.084, wheelbase=0.158, front_share=0.035, wheel_radius=0.022, door_setback=0.07,
    door_share=0.03, windscreen_setback=0.13, tail_run=0.32, glass_height=0.04, roof_inset=0.05, sill_height=0.05,
    lamp_drop=0.05, lamp_inner=0.06, nose_sweep=0.10, tail_lamp_drop=0.07, tail_lamp_inner=0.08, tail_sweep=0.08,
    boot_sill=0.08, rear_plate=0.14,
)  # fmt: skip
"""One standard deviation of each dimension over city cars, hatchbacks, saloons and SUVs."""


def dimension_covariance() -> Float[np.ndarray, "d d"]:
    """Covariance of the dimensions in the order of their fields: the published ones together, the rest independent."""
    covariance = np.diag(np.square(astuple(DEVIATIONS)))
    covariance[:4, :4] = np.cov(np.array(list(PUBLISHED_MM.values())).T / 1000)
    return covariance


def keypoints_of(dimensions: CarDimensions) -> Float[np.ndarray, "66 3"]:
    """The 66 points of a car with these dimensions, metres, car frame; exactly mirror symmetric."""
    d, half, half_w = dimensions, dimensions.length / 2, dimensions.width / 2
    front_axle = half - d.front_share * (d.length - d.wheelbase)
    rear_axle, arch, belt = front_axle - d.wheelbase, d.wheel_radius + 0.04, d.height - d.glass_height
    front_door, rear_arch, c_pillar = front_axle - d.door_setback, rear_axle + arch, rear_axle + 0.05
    b_pillar = front_door - d.door_share * (front_door - rear_arch)
    slope = 0.07 / (front_door - c_pillar)  # of the belt line, which rises towards the rear
    belt_a, belt_c = belt - slope * (front_door - b_pillar), belt + slope * (b_pillar - c_pillar)
    lamp, tail = belt - d.lamp_drop, belt - d.tail_lamp_drop

    # Seen from above, the ends are flat in the middle and turn quickly at the corners; bumpers are squarer than lamps.
    def nose(y: float, lean: float, level: float = 1.0) -> float:
        return half - lean - level * d.nose_sweep * (y / half_w) ** 2.4

    def rear(y: float, lean: float, level: float = 1.0) -> float:
        return -half + lean + level * d.tail_sweep * (y / half_w) ** 2.4

    # Above the belt and towards both ends the body is narrower than across the wheel arches, where width is measured.
    lamp_y, tail_y, fog_y, corner_y, plate = half_w - 0.11, half_w - 0.13, 0.80 * half_w, 0.74 * half_w, 0.23
    return _both_sides({
        # headlamp: inner top and bottom, outer top and bottom, the outer end drawn up and back; fog lamp: outer end
        0: (nose(d.lamp_inner, 0.07), d.lamp_inner, lamp + 0.04), 2: (nose(lamp_y, 0.07), lamp_y, lamp + 0.09),
        1: (nose(d.lamp_inner, 0.02), d.lamp_inner, lamp - 0.08), 3: (nose(lamp_y, -0.01), lamp_y, lamp - 0.05),
        4: (nose(fog_y, 0.01, 0.6), fog_y, 0.45), 5: (nose(fog_y, 0.01, 0.6), fog_y, 0.35),
        # lower end of the front bumper before the arch, centres of the rims, lower end of the rear bumper
        6: (front_axle + arch + 0.01, half_w - 0.06, 0.28), 7: (front_axle, half_w - 0.05, d.wheel_radius),
        20: (rear_axle, half_w - 0.05, d.wheel_radius), 21: (rear_axle - arch - 0.01, half_w - 0.06, 0.28),
        # upper corners of windscreen and rear screen: below the peak of the roof, which rises between and is crowned
        8: (front_axle - d.windscreen_setback, half_w - d.roof_inset, d.height - 0.13),
        24: (d.tail_run - half, half_w - 1.1 * d.roof_inset, d.height - 0.13),
        # front door: front at belt line and sill, head of the B pillar, rear at belt line and sill
        9: (front_door - 0.05, half_w - 0.08, belt_a + 0.02), 10: (front_door, half_w - 0.08, d.sill_height),
        11: (b_pillar - 0.08, half_w - 0.85 * d.roof_inset, d.height - 0.12),
        12: (b_pillar - 0.02, half_w - 0.09, belt + 0.01), 15: (b_pillar, half_w - 0.07, d.sill_height),
        # rear door: rear end at the belt line, lower rear corner before the arch; handles, front and rear end
        16: (c_pillar, half_w - 0.13, belt_c + 0.02), 19: (rear_arch + 0.08, half_w - 0.07, d.sill_height),
        13: (b_pillar + 0.26, half_w - 0.04, belt - 0.12), 14: (b_pillar + 0.07, half_w - 0.04, belt - 0.12),
        17: (c_pillar + 0.30, half_w - 0.05, belt_c - 0.12), 18: (c_pillar + 0.11, half_w - 0.05, belt_c - 0.12),
        # tail lamp: outer top and bottom, inner top and bottom
        22: (rear(tail_y, 0.11), tail_y, tail + 0.09), 23: (rear(tail_y, 0.04), tail_y, tail - 0.10),
        25: (rear(d.tail_lamp_inner, 0.11), d.tail_lamp_inner, tail + 0.07),
        26: (rear(d.tail_lamp_inner, 0.05), d.tail_lamp_inner, tail - 0.10),
        # lower corners of the boot lid and of the rear bumper; number plates (305 to 520 mm wide), both corners
        27: (rear(0.48, 0.03), 0.48, d.boot_sill), 28: (rear(corner_y, 0.0, 0.7), corner_y, 0.40),
        59: (nose(plate, 0.01, 0.6), plate, 0.52), 61: (nose(plate, 0.01, 0.6), plate, 0.40),
        62: (rear(plate, 0.06), plate, d.rear_plate + 0.06), 65: (rear(plate, 0.04), plate, d.rear_plate - 0.06),
    })  # fmt: skip


def _both_sides(left: dict[int, tuple[float, float, float]]) -> Float[np.ndarray, "66 3"]:
    """Points or directions of the left side, by their index among the 66, and their mirror images."""
    both = np.empty((len(APOLLOCAR3D_66), 3))
    for j, (x, y, z) in left.items():
        both[j], both[APOLLOCAR3D_66.flip[j]] = (x, y, z), (x, -y, z)
    return both


_LEFT_NORMALS: dict[tuple[float, float, float], tuple[int, ...]] = {
    (1.0, 0.35, 0.3): (0, 1), (0.75, 0.65, 0.2): (2, 3), (0.85, 0.5, 0.0): (4, 5), (0.15, 1.0, 0.0): (6,),
    (0.0, 1.0, 0.0): (7, 20), (0.6, 0.35, 0.7): (8,), (0.0, 1.0, 0.2): (9, 12, 16), (0.0, 1.0, -0.15): (10, 15, 19),
    (0.0, 0.93, 0.37): (11,), (0.0, 1.0, 0.05): (13, 14, 17, 18), (-0.15, 1.0, 0.0): (21,), (-0.6, 0.35, 0.7): (24,),
    (-0.65, 0.75, 0.1): (22, 23), (-1.0, 0.2, 0.15): (25, 26), (-1.0, 0.2, 0.0): (27,), (-0.85, 0.5, 0.0): (28,),
    (1.0, 0.0, 0.0): (59, 61), (-1.0, 0.0, 0.1): (62, 65),
}  # fmt: skip
"""Outward direction of the surface, not normalised: the left points that share it."""


@dataclass(frozen=True, eq=False)
class CarTemplate:
    """Gaussian distribution over the J points of a car, metres, car frame.

    points = mean + sum_k c_k basis[k] + residual with c_k ~ N(0, 1). On each axis a left point moves by s + a beyond
    the dimensions, its partner by the mirror image of s - a.
    """

    mean: Float[np.ndarray, "j 3"]
    """The average car."""
    basis: Float[np.ndarray, "k j 3"]
    """Displacements per standard deviation of K independent coefficients of the dimensions."""
    length_basis: Float[np.ndarray, "k"]
    """What each coefficient adds to the length from bumper to bumper."""
    normals: Float[np.ndarray, "j 3"]
    """Outward unit normals of the surface at the points."""
    flip: tuple[int, ...]
    """Index of each point's mirror partner, itself where it has none."""
    sigma_symmetric_m: float = 0.05
    """Standard deviation of s, shared by both sides."""
    sigma_asymmetric_m: float = 0.03
    """Standard deviation of a, by which the sides differ."""

    def covariance(self) -> Float[np.ndarray, "n n"]:
        """Covariance of the points, n = 3J, at index 3 * j + axis; positive definite. Computed once."""
        return self._moments[0]

    def precision(self) -> Float[np.ndarray, "n n"]:
        """Inverse of the covariance. Computed once."""
        return self._moments[1]

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        count = len(self.mean)
        own, partner = np.arange(count), np.array(self.flip)
        mirror = np.zeros((count, 3, count, 3))
        for axis, sign in enumerate((1.0, -1.0, 1.0)):
            mirror[own, axis, partner, axis] = np.where(own == partner, 0.0, sign)
        symmetric, asymmetric = self.sigma_symmetric_m**2, self.sigma_asymmetric_m**2
        residual = (symmetric - asymmetric) * mirror.reshape(3 * count, 3 * count)
        residual += (symmetric + asymmetric) * np.eye(3 * count)
        basis = self.basis.reshape(len(self.basis), -1)
        covariance = basis.T @ basis + residual
        precision = np.linalg.inv(covariance)
        return covariance, (precision + precision.T) / 2

    def length_m(self, points: Float[np.ndarray, "j 3"]) -> float:
        """Expected length from bumper to bumper given solved points in the car frame (NaN rows: unknown), metres.

        The outermost points lie some way inside the bumper ends; how far, the other points tell. The ends are two more
        points of the same Gaussian. Two parts of it count only here: a shift of all points together, since the origin
        is where the ends say, and a smooth bend of the body that the dimensions do not describe.
        """
        known, average = np.isfinite(points).all(-1).repeat(3), CarDimensions().length
        offset = (points - self.mean).ravel()[known]
        ends = np.array([[average / 2, 0.0, 0.5], [-average / 2, 0.0, 0.5]])
        # 1 m of shift; 8 cm of bend, alike at points within 0.6 m of each other.
        squared = np.square(np.concatenate([self.mean, ends])[:, None] - self.mean).sum(-1)
        common = 1.0 + 0.08**2 * np.exp(squared / (-2 * 0.6**2))
        axes = np.eye(3)
        covariance = self.covariance() + np.kron(common[:-2], axes)
        basis = self.basis.reshape(len(self.basis), -1)
        cross = self.length_basis @ basis + np.kron(common[-2] - common[-1], axes[0])
        return average + float(cross[known] @ np.linalg.solve(covariance[known][:, known], offset))


@lru_cache(maxsize=8)
def car_template(schema: KeypointSchema) -> CarTemplate | None:
    """The template in the order of a schema whose names and pairs are all among the 66 points'; None for any other."""
    index_of = {name: j for j, name in enumerate(APOLLOCAR3D_66.keypoints)}
    index = [index_of.get(name, -1) for name in schema.keypoints]
    paired = all(f == j or index[f] == APOLLOCAR3D_66.flip[index[j]] for j, f in enumerate(schema.flip))
    if -1 in index or len(set(index)) < len(index) or not paired:
        return None
    directions = _both_sides({j: direction for direction, group in _LEFT_NORMALS.items() for j in group})
    normals = unit(directions)[index]
    # Central differences: the points are almost quadratic in the dimensions.
    at, step = np.array(astuple(CarDimensions())), 1e-4
    changed = at + step * np.array([[[-1.0]], [[1.0]]]) * np.eye(len(at))
    less, more = (np.stack([keypoints_of(CarDimensions(*row)) for row in rows]) for rows in changed.tolist())
    # The factor is lower triangular and length the first dimension: only the first coefficient changes the length.
    factor = np.linalg.cholesky(dimension_covariance())
    basis = np.einsum("dk,djc->kjc", factor, (more - less) / (2 * step))[:, index]
    return CarTemplate(keypoints_of(CarDimensions())[index], basis, factor[0], normals, schema.flip)
