"""Domain randomization of a box that the tool pushes: `dr=box`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from r2s.errors import check_number
from r2s.learning.randomization import UniformRandomization, check_pair
from r2s.physics.box import TableFrame, check_size, standing_box, table_frame
from r2s.physics.dynamics import Dynamics

RANGES = "mass", "table", "friction", "damping", "bristle"


@dataclass(frozen=True, kw_only=True)
class BoxRandomization(UniformRandomization):
    """Draw random arms from `UniformRandomization` and a random box for each arm.

    Mass and stiffness of the box are log-uniform; its other parameters are uniform. The box's initial pose deviates
    from the nominal pose by U(-spread, spread) in x and in y, and by U(-yaw, yaw) in yaw.

    Attributes:
        table: range [least, most] of the friction coefficient between box and table. friction: the same, between tip
            and box. mass (kg), stiffness (N/m), damping (s/m), bristle (m): ranges [least, most], see `Surface`.
        size: (3,) m, edges of the box.
        spread, yaw: m and degrees, largest deviation of the box from its nominal pose.
        point, normal: point (3,) m and normal (3,) of the table; if None, see `table_frame`.

    Raises:
        UserError: a range is malformed, a push would tilt the box, or the robot has no tool.
    """

    size: Sequence[float]
    mass: Sequence[float]
    table: Sequence[float]
    friction: Sequence[float]
    stiffness: Sequence[float]
    damping: Sequence[float]
    bristle: Sequence[float]
    spread: float
    yaw: float
    point: Sequence[float] | None = None
    normal: Sequence[float] | None = None

    @cached_property
    def _frame(self) -> TableFrame:
        return table_frame(self.robot, self.point, self.normal)

    def __post_init__(self):
        super().__post_init__()
        _ = self._frame  # raises UserError for wrong settings
        for name in ("stiffness", *RANGES):
            check_pair(name, getattr(self, name), "(0, inf)" if name in ("mass", "stiffness") else "[0, inf)")
        check_size("dr.size", self.size, self.table[1])
        check_number("dr.spread", self.spread, "[0, inf)")
        check_number("dr.yaw", self.yaw, "[0, 180]")

    def __call__(self, rng: np.random.Generator, m: int) -> Dynamics:
        """Return random dynamics of m arms, each arm with a random box."""

        def drawn(low: float, high: float) -> np.ndarray:
            return rng.uniform(low, high, m)

        law = {name: drawn(*getattr(self, name)) for name in RANGES[1:]}
        law |= {name: np.exp(drawn(*np.log(getattr(self, name)))) for name in ("mass", "stiffness")}
        most = np.array([self.spread, self.spread, np.radians(self.yaw)])
        box = standing_box(self._frame, rng.uniform(-most, most, (m, 3)), self.size, **law)
        return replace(super().__call__(rng, m), surface=box)
