"""Other people's programs as partners of ours: what of them is there, and which tests that leaves out."""

import shutil

from tests.foreign import canopennode

#: File pattern of this folder -> why it is not collected.
LEFT_OUT = {
    pattern: reason
    for pattern, reason in {
        "test_*.py": canopennode.missing(),
        "test_capture.py": "" if shutil.which("tshark") else "no tshark",
    }.items()
    if reason
}
