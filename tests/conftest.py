"""Settings every test shares. Must run before anything imports jax: rollouts are compared at one XLA thread."""

import os

os.environ["PJRT_NPROC"] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"
