"""Options of `servoctl synthesize`: every one with its range and a line of help; a default of None is the mode's own.

Imports typer alone, as all verbs do.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Mode(StrEnum):
    """The programme that is solved."""

    DEPLOYED = "deployed"
    REFERENCE = "reference"


class Weights(StrEnum):
    """Shapes of the weighting functions."""

    LINEAR = "linear"
    COSINE = "cosine"
    GAUSSIAN = "gaussian"


class Velocity(StrEnum):
    """Whose velocity drives the friction state."""

    REFERENCE = "reference"
    MEASURED = "measured"


Model = Annotated[Path, typer.Option(help="Axis model (YAML).")]
Out = Annotated[Path, typer.Option(help="Gain set to write (YAML).")]
Name = Annotated[str, typer.Option(help="Name of the gain set.")]
ModeOption = Annotated[Mode, typer.Option(help="Sampled, with delay and filter; or the paper's own programme.")]
ScalarOutput = Annotated[bool, typer.Option("--scalar-output", help="Reference mode: the literal alpha*x + beta*u*.")]
CrossCheck = Annotated[bool, typer.Option("--cross-check", help="Solve again with SCS, and compare; half a minute.")]

Alpha = Annotated[float | None, typer.Option(min=1e-3, max=1e3, help="Weight alpha of the position error.")]
Beta = Annotated[float | None, typer.Option(min=1e-4, max=1e2, help="Weight beta of the torque.")]
Decay = Annotated[float | None, typer.Option(min=0.1, max=500.0, help="Least decay, 1/s.")]
ZetaMin = Annotated[
    float | None, typer.Option("--zeta-min", "--damping", min=0.001, max=0.85, help="Least damping ratio.")
]
Uncertainty = Annotated[float, typer.Option(min=0.0, max=10.0, help="Scale of all intervals.")]
Delay = Annotated[float | None, typer.Option(min=0.0, max=0.02, help="Command to torque, s, instead of the model's.")]
Period = Annotated[int, typer.Option(min=250, max=10_000, help="Cycle, microseconds.")]
Cutoff = Annotated[float | None, typer.Option(min=10.0, max=2000.0, help="Velocity filter, Hz, instead of the best.")]
Counts = Annotated[int, typer.Option(min=0, max=2**40, help="Encoder counts per turn; 0 is no steps.")]

Speed = Annotated[float, typer.Option(min=0.01, max=100.0, help="Highest speed of the map, rad/s.")]
OverlapFrom = Annotated[float, typer.Option(min=1e-5, max=10.0, help="Omega_H begins at this speed, rad/s.")]
OverlapTo = Annotated[float, typer.Option(min=1e-5, max=10.0, help="Omega_L ends at this speed, rad/s.")]
Accuracy = Annotated[float, typer.Option(min=0.001, max=0.5, help="Force tolerance between local sets, a share.")]
PaperNodes = Annotated[bool, typer.Option("--paper-nodes", help="The paper's nine local sets.")]
WeightsOption = Annotated[Weights, typer.Option(help="Shape of the weighting functions.")]
VelocityOption = Annotated[Velocity, typer.Option(help="Whose velocity drives the friction state.")]
Observer = Annotated[bool, typer.Option(help="Output disturbance observer.")]
PositionTorque = Annotated[bool, typer.Option(help="Feed known torques over position forward.")]
Leak = Annotated[float, typer.Option(min=0.0, max=100.0, help="Least decay of the friction state, 1/s.")]
GainL = Annotated[float | None, typer.Option("--l", min=-1.0, max=1.0, help="l of all local sets; else designed.")]
