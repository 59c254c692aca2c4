"""What runs inside the guest as root, one JSON line for each thing that was tried: `python3 -m inside SHARE`.

SHARE is the host's folder, with site/, systemd/, gains/ and tests/. Until `install` has put servod in place, nothing
but the standard library is imported; no timing of the machine is judged here.
"""
