"""The virtual world: a CAN bus, an amplifier, an encoder and the joint between them, on wall or virtual time.

The other end of the data path: everything here stands where real hardware would, behind the wire. It shares tables,
units and the frame codec with the master side, nothing that acts.
"""
