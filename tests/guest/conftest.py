"""The guest is built and booted only where it is asked for: SERVOD_GUEST=1 pytest -m guest tests/guest."""

import os

collect_ignore = [] if os.environ.get("SERVOD_GUEST") == "1" else ["test_guest.py"]
