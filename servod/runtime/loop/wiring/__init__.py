"""The test of the wiring before the first torque: signs and sizes of torque, encoder and feedback."""
