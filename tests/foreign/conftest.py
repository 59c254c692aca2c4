"""Other people's programs as partners: what they are made of lies beside the project, and need not be there."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.foreign import LEFT_OUT, canopennode

collect_ignore_glob = list(LEFT_OUT)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """CANopenNode's programs, made once for all workers."""
    base = tmp_path_factory.getbasetemp()
    return canopennode.build((base if worker_id == "master" else base.parent) / "canopennode")
