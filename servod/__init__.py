"""servod: deploys friction-compensating controllers to CANopen servo axes, and keeps the axis model honest."""

__version__ = "0.1.0"
