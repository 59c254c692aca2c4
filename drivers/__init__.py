"""The drivers of this house, found by name through servod.runtime.fieldbus.registry; nothing imports them.

Import as `servod.drivers`, never the bare folder.
"""
