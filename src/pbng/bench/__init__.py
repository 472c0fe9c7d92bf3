"""Measurements that back what the documentation says; run as ``pbng bench``."""

from pbng.bench.cli import app

__all__ = ["app"]
