"""Measurements on one GPU; see `__main__.py`."""
