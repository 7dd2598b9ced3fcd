"""Make a hidden twin, rigid or elastic: `arm=twin arm.variant=rigid|elastic`."""

from typing import Any

from r2s.arm.twins.elastic_twin import ElasticTwin
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.arm.twins.twin_base import TwinBase
from r2s.errors import UserError, instead_of
from r2s.physics.robot import Robot

VARIANTS: dict[str, type[TwinBase]] = {"rigid": RigidTwin, "elastic": ElasticTwin}


def make_twin(
    robot: Robot,
    *,
    variant: str = "rigid",
    seed: int = 0,
    payload: Any = 0.0,
    declared_payload: Any = None,
    stiffness: float | None = None,
    noise: int = 0,
    friction_scale: float = 1.0,
    extra_delay_s: float = 0.0,
    surface: Any = False,
) -> TwinBase:
    """Return a hidden twin; `TwinBase` explains the arguments, which conf/arm/twin.yaml sets.

    Args:
        variant: 'rigid': a twin in DART with LuGre friction; its gears are rigid or deflect without oscillation.
            'elastic': a twin with effects that no identified model contains, see r2s/arm/twins/elastic_twin.py.

    Raises:
        UserError: the variant is unknown, or an argument is out of its range.
    """
    if not isinstance(variant, str) or variant not in VARIANTS:
        raise UserError(f"arm.variant: {variant!r}; {instead_of(variant, VARIANTS)}")
    return VARIANTS[variant](
        robot,
        seed,
        payload=payload,
        declared_payload=declared_payload,
        stiffness=stiffness,
        noise=noise,
        friction_scale=friction_scale,
        extra_delay_s=extra_delay_s,
        surface=surface,
    )
