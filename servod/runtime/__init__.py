"""What runs beside the machine: field bus, control loop, daemon. Nothing here needs the laboratory."""
