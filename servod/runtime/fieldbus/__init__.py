"""From the wire to devices: CiA tables, what a device is, buses, registry of drivers, CANopen master."""
