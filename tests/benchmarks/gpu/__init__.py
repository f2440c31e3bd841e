"""Measurements on one GPU: of the rollout xla (`__main__.py`), and of kernels of our compiler (`on_device.py`)."""
