"""The one physics that simulator, identification, synthesis, diagnosis and virtual plant share.

Friction laws and axis dynamics as plain functions on floats and numbers by name (`layout`); pure Python as they stand,
compiled from the same source by `compiled` when numba is installed. Nothing here knows a bus or a file.
"""
