"""The roof: one module a command group, over functions that a notebook could call."""

from __future__ import annotations

from chromeball.cli.main import main

__all__ = ["main"]
