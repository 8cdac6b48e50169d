"""What all tests share."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def own_cache(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No test sees what another, or the user, has kept."""
    monkeypatch.setenv("CHROMEBALL_CACHE", str(tmp_path_factory.mktemp("cache")))
