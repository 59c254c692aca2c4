"""Group of keys of the axis model file: what makes torque of the command where a recording has no torque.

Beside the groups of physics. Replay and diagnosis read it for recordings of a goal position, a goal speed, a duty, a
voltage or a current; whoever commands a torque (simulator, synthesis, the virtual plant) does not need it.
Torque means force and rad means m when `axis: linear`.
"""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field, model_validator

from servod.formats.model.keys import Factor, Group, NonNegative, Positive


class DriveKind(StrEnum):
    """What the drive is told: a position, a speed, a voltage or a current."""

    POSITION_SERVO = "position_servo"
    VELOCITY = "velocity"
    VOLTAGE = "voltage"
    CURRENT = "current"

    @property
    def feeds_back(self) -> bool:
        """Whether the drive closes a loop of its own over the position or the speed."""
        return self in {DriveKind.POSITION_SERVO, DriveKind.VELOCITY}


class DriveLaw(Group):
    """Torque of the command: torque_per_command*clip(gain_scale*(kp*e + ki*integral(e)) - gain_scale*kd*v, +-limit).

    e = goal(t - delay) - position (position_servo) or - speed (velocity); a voltage or current is clipped as it is. The
    delay (`delay_s` of drive and model, and `delay`) is on the command's way, not on that of the position fed back.
    Without `torque_per_command`: gear*k_t/resistance*supply (servo, duty), gear*k_t/resistance (voltage), gear*k_t
    (current). A drive that is off makes no torque and no back-EMF. What is unknown is fitted.
    Source: the servo's firmware; back-EMF: Krause et al., Analysis of Electric Machinery, 2013.
    """

    plain = True

    kind: DriveKind = Field(description="what the command is")
    kp: Positive | None = Field(None, description="duty/rad (duty*s/rad with velocity); none: the recording's `kp`")
    ki: NonNegative = Field(0.0, description="duty/(rad*s)")
    kd: NonNegative = Field(0.0, description="duty*s/rad, on the measured speed")
    gain_scale: Factor = Field(1.0, description="duty per unit of the gains, as firmware scales them")
    dead_band: NonNegative = Field(0.0, description="errors up to this make no duty, rad (rad/s)")
    goal_rate: Positive | None = Field(None, description="the goal is followed at most so fast, 1/s of its unit")
    limit: Positive | None = Field(None, description="largest duty (1 where not given), V or A (no limit)")
    delay_s: float = Field(0.0, ge=0.0, le=0.25, description="on the command's way, besides the model's own")
    torque_per_command: Positive | None = Field(None, description="N*m at full duty, per V or per A, at the joint")
    supply_v: Positive | None = Field(None, description="V, where the recording has none; that of torque_per_command")
    emf_viscous: NonNegative = Field(
        0.0, description="N*m*s/rad at the joint, besides friction.viscous while the drive is on: its back-EMF"
    )
    k_t: Positive | None = Field(None, description="N*m/A of the motor")
    k_e: NonNegative | None = Field(None, description="V*s/rad of the motor: emf_viscous gear^2*k_t*k_e/resistance")
    resistance: Positive | None = Field(None, description="ohm")
    gear: Positive = Field(1.0, description="turns of the motor for one of the joint (rad/m when linear)")

    @model_validator(mode="after")
    def _keys_have_meaning(self) -> DriveLaw:
        loop = {"kp", "ki", "kd", "gain_scale", "dead_band"} & self.model_fields_set
        if loop and not self.kind.feeds_back:
            raise ValueError(f"no {min(loop)}: kind {self.kind.value} has no loop of its own")
        motor = {"k_t", "k_e", "resistance"} & self.model_fields_set
        if motor and self.torque_per_command is not None:
            raise ValueError(f"torque_per_command or {min(motor)}, not both")
        if self.kind is not DriveKind.CURRENT and (self.k_t is None) != (self.resistance is None):
            raise ValueError("k_t and resistance together")
        if self.kind is DriveKind.CURRENT and (self.resistance is not None or self.k_e is not None):
            raise ValueError("no resistance or k_e: a current drive overcomes both")
        if self.k_e is not None and (self.k_t is None or self.emf_viscous):
            raise ValueError("k_e only beside k_t and resistance, and not beside emf_viscous")
        return self

    @property
    def most(self) -> float | None:
        """Largest command behind the loop: duty, V or A; None without a limit."""
        return 1.0 if self.limit is None and self.kind.feeds_back else self.limit

    @property
    def factor(self) -> float | None:
        """Torque of a command of one: N*m at full duty *per volt of supply* (`by_supply`), per V or per A, or None."""
        if self.torque_per_command is not None:
            per_volt = self.by_supply and self.supply_v is not None
            return self.torque_per_command / self.supply_v if per_volt and self.supply_v else self.torque_per_command
        if self.k_t is None:
            return None
        return self.gear * self.k_t / (self.resistance if self.resistance is not None else 1.0)

    @property
    def by_supply(self) -> bool:
        """Whether the torque goes with the supply: a duty of it acts, and what one volt makes is known."""
        return self.kind.feeds_back and (self.k_t is not None or self.supply_v is not None)

    @property
    def back_emf(self) -> float:
        """Viscous friction that the back-EMF makes while the drive is on, N*m*s/rad."""
        if self.k_t is None or self.k_e is None or self.resistance is None:
            return self.emf_viscous
        return self.gear**2 * self.k_t * self.k_e / self.resistance
